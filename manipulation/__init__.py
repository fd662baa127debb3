"""A pose to a deed: kinematics, planning, trajectories, guarded and compliant motion, one file a skill."""
