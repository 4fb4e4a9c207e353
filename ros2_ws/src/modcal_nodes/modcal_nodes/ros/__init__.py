"""What every node needs of ROS: subscriptions, parameters, health, lifecycle, signals, frames."""

# ruff: noqa: I001

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from modcal_nodes.ros.guarded import GuardedNode, NodeEnds
    from modcal_nodes.ros.launch_files import LAUNCHES
    from modcal_nodes.ros.lifecycle import DONE, FAILED, NO_DESCRIPTION, REFUSED, Action, HealthyNode, ManagedNode
    from modcal_nodes.ros.lifecycle import interface
    from modcal_nodes.ros.parameters import SIMULATED_CELL
    from modcal_nodes.ros.running import FRESH, LATCHED, SENSOR, settle_in
    from modcal_nodes.ros.subscriptions import ERROR, OK, WARN, MonitoredSubscription, Status, always
    from modcal_nodes.ros.subscriptions import subscription_status, tracker_status
    from modcal_nodes.ros.tf_frames import Broadcaster, corrected_frame, static_frames
    from modcal_nodes.ros.topic_recorder import MUTUAL, UNHEARD, Complaint, Taken, TopicRecorder, interrupt, joined
    from modcal_nodes.ros.topic_recorder import passing, stopped_by, type_of
else:
    from modcal_core.lazy import lazy_face

    __getattr__ = lazy_face(__name__, __file__)
