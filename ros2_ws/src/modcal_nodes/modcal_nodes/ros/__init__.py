"""What every node needs of ROS: subscriptions, parameters, health, lifecycle, signals, frames."""
