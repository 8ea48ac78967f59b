"""Move the arm by joints and by a pose of the gripper's pivot; a goal beyond a limit is rejected before it moves."""

import numpy as np

from hal.base import z1
from hal.base.errors import InvalidValueError
from hal.base.messages import ArmState
from hal.base.z1_model import ForwardKinematics
from z1_runtime import Robot


def main() -> ArmState:
    """Return the state after the last motion."""
    with Robot.simulate() as robot:
        robot.move_to(z1.Q_HOME + 0.1, jaw=-0.5)
        T_base_pivot = ForwardKinematics().pivot(z1.Q_HOME)
        T_base_pivot[2, 3] += 0.03
        state = robot.move_to(T_base_pivot)
        try:
            robot.move_to(np.full(z1.N_ARM, 9.0))
        except InvalidValueError as error:
            print(f"rejected: {error}")
    print(f"joints [rad]: {state.q.round(3)}")
    return state


if __name__ == "__main__":
    main()
