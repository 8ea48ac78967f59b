"""Every motion of the vendor's module, one after the other."""

import sys
import time

sys.path.append("../lib")
import numpy as np
import unitree_arm_interface as sdk


def line(name, value):
    print(name, np.array2string(np.asarray(value, dtype=float), precision=3, suppress_small=True, max_line_width=200))


arm = sdk.ArmInterface(hasGripper=True)
states = sdk.ArmFSMState
model = arm._ctrlComp.armModel
arm.loopOn()

arm.labelRun("forward")
line("forward", arm.lowstate.getQ())

arm.startTrack(states.JOINTCTRL)
for _ in range(200):
    arm.jointCtrlCmd(np.array([1, 0, 0, 0, 0, 0, -1]), 0.5)
    time.sleep(arm._ctrlComp.dt)
time.sleep(0.2)
line("jogged", arm.q)
line("jogged to", [*arm.lowstate.getQ(), arm.lowstate.getGripperQ()])

goal = np.array([0.0, 0.0, 0.0, 0.45, -0.1, 0.35])
print("MoveJ", arm.MoveJ(goal, -0.5, 2.0))
line("MoveJ to", sdk.homoToPosture(model.forwardKinematics(arm.lowstate.getQ(), 6)))
print("MoveL", arm.MoveL(goal + np.array([0, 0, 0, 0, 0.1, 0]), 0.3))
line("MoveL to", sdk.homoToPosture(model.forwardKinematics(arm.lowstate.getQ(), 6)))
print("MoveC", arm.MoveC(goal + np.array([0, 0, 0, 0, 0.15, 0.05]), goal + np.array([0, 0, 0, 0, 0.2, 0]), 0.0, 0.3))
line("MoveC to", sdk.homoToPosture(model.forwardKinematics(arm.lowstate.getQ(), 6)))
print("unreachable", arm.MoveJ(np.array([0, 0, 0, 2.0, 0, 0]), 1.0))

arm.startTrack(states.CARTESIAN)
before = sdk.homoToPosture(model.forwardKinematics(arm.q, 6))
for _ in range(200):
    arm.cartesianCtrlCmd(np.array([0, 0, 0, 0, 0, -1, -1]), 0.3, 0.1)
    time.sleep(arm._ctrlComp.dt)
print("CARTESIAN", arm.getCurrentState() == states.CARTESIAN)
after = sdk.homoToPosture(model.forwardKinematics(arm.q, 6))
line("sideways", after[3:5] - before[3:5])
print("down", after[5] < before[5] - 0.01)

arm.backToStart()
line("start", arm.lowstate.getQ())
arm.labelSave("here")
arm.setFsm(states.PASSIVE)
print("passive", arm.getCurrentState().name)

arm.setFsmLowcmd()
print("low level", arm.getCurrentState().name)
first, goal, steps = arm.lowstate.getQ(), np.array([0.2, 0.6, -0.6, -0.1, 0.0, 0.0]), 400
rate = (goal - first) / (steps * arm._ctrlComp.dt)
for i in range(steps):
    q = first + (goal - first) * (i + 1) / steps
    tau = model.inverseDynamics(q, rate, np.zeros(6), np.zeros(6))
    arm.setArmCmd(q, rate, tau)
    arm.setGripperCmd(-0.5 * i / steps, 0.0, 0.0)
    arm.sendRecv()
    time.sleep(arm._ctrlComp.dt)
for _ in range(150):
    arm.setArmCmd(goal, np.zeros(6), model.inverseDynamics(goal, np.zeros(6), np.zeros(6), np.zeros(6)))
    arm.sendRecv()
    time.sleep(arm._ctrlComp.dt)
line("low level to", arm.lowstate.getQ())
print("motors", len(arm.lowstate.temperature), max(arm.lowstate.errorstate), max(arm.lowstate.isMotorConnected))

arm.loopOn()
arm.backToStart()
arm.loopOff()
print("end", arm.getCurrentState().name)
