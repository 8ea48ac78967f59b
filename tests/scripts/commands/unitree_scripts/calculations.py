"""The vendor's model alone, without a controller."""

import numpy as np
import unitree_arm_interface as sdk

arm = sdk.ArmInterface(True)
model = arm._ctrlComp.armModel
q, near = np.array([0.0, 1.5, -1.0, 0.54, 0.0, 0.0]), np.array([0.0, 1.49, -1.0, 0.57, 0.0, 0.0])
T = model.forwardKinematics(q, 6)
found, other = model.inverseKinematics(T, np.zeros(6), True)
print("any", found, np.allclose(model.forwardKinematics(other, 6), T, atol=1e-6))
print("far", model.inverseKinematics(T, np.zeros(6), False)[0])
found, same = model.inverseKinematics(T, near, False)
print("near", found, np.allclose(same, q, atol=1e-6))
twist = np.array([0.0, 0.0, 0.0, 0.1, 0.0, 0.0])
J = model.CalcJacobian(q)
print("twist", np.allclose(J @ model.solveQP(twist, q, arm._ctrlComp.dt), twist, atol=1e-3))
weight = model.inverseDynamics(q, np.zeros(6), np.zeros(6), np.zeros(6))
print("weight", weight.shape, abs(weight[1]) > 1.0)
print("limits", len(model.getJointQMax()), len(model.getJointQMin()), len(model.getJointSpeedMax()))
print("protected", model.jointProtect(np.full(6, 9.0), np.full(6, 99.0))[0][0] < 3.0)
print("singular", model.checkInSingularity(np.zeros(6)), np.allclose(sdk.postureToHomo(sdk.homoToPosture(T)), T))
