"""QP inverse kinematics with control barrier functions, and the replay of logged motion (paper, III-E)."""
