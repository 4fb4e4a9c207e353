"""ROS messages to and from modcal's own arrays: in bags and on the wire, by the same functions. No nodes."""
