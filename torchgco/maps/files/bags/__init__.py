"""Maps in ROS's bags: the last message of a topic of point clouds or grids.

Small readers of their own: the library `rosbags` unpacks without a bound, goes through one part of a file as often as
the file says, and makes Python code from the definitions that a bag brings. Tests read what it writes.
"""
