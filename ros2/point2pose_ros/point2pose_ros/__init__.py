"""Point2Pose as a node for ROS 2: ``node.py`` spins it, ``messages.py`` translates."""
