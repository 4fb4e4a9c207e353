"""modcal's mathematics: kinematics, identification and what is left over. NumPy and SciPy only, no ROS.

Conventions, used everywhere and stated once: SI units (m, rad, s, N, kg); ``T_a_b`` is the pose of b in a, so
``p_a = T_a_b @ p_b``; twists are (v, ω), linear part first; quaternions are x y z w; arrays are float64 with the batch
axis first; joints are ordered by name, never by their place in a message.
"""

__version__ = "0.1.0"
