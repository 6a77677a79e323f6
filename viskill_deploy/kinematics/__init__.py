"""Robot files to Pinocchio models: forward kinematics, Jacobian, inverse, QP IK."""
