"""`unitree_arm_interface` without the vendor's library: its scripts run on any Python, on the arm or on the twin.

New scripts use `import hal.compat.unitree_arm_interface as unitree_arm_interface`; unmodified ones, which use
`import unitree_arm_interface`, run after `install()` or inside `with masquerade():`.
"""

from hal.compat.unitree_arm_interface.arm import ArmInterface as ArmInterface
from hal.compat.unitree_arm_interface.lowlevel import RECVSTATE_LENGTH as RECVSTATE_LENGTH
from hal.compat.unitree_arm_interface.lowlevel import ArmFSMState as ArmFSMState
from hal.compat.unitree_arm_interface.lowlevel import BlockYN as BlockYN
from hal.compat.unitree_arm_interface.lowlevel import CtrlComponents as CtrlComponents
from hal.compat.unitree_arm_interface.lowlevel import LowlevelCmd as LowlevelCmd
from hal.compat.unitree_arm_interface.lowlevel import LowlevelState as LowlevelState
from hal.compat.unitree_arm_interface.lowlevel import UDPPort as UDPPort
from hal.compat.unitree_arm_interface.model import Z1Model as Z1Model
from hal.compat.unitree_arm_interface.model import homoToPosture as homoToPosture
from hal.compat.unitree_arm_interface.model import postureToHomo as postureToHomo
from hal.compat.unitree_arm_interface.port import install as install
from hal.compat.unitree_arm_interface.port import masquerade as masquerade
