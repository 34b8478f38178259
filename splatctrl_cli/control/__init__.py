"""III-E: barriers, QP inverse kinematics, replay loop."""
