# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Finds the wanted topics in the graph, and listens so that every publisher is heard."""

from collections.abc import Callable, Sequence

from rclpy.node import Node
from rclpy.topic_endpoint_info import TopicEndpointInfo

from t3mpc_ros.nodes.plumbing import graph, quality
from t3mpc_ros.nodes.recording.ears import Ears
from t3mpc_ros.record.writing.selection import Selection

EXPECTED = {
    'reference': 'nav_msgs/msg/Odometry',
    'odom': 'nav_msgs/msg/Odometry',
    'ground_truth/odom': 'nav_msgs/msg/Odometry',
    'cmd_vel': 'geometry_msgs/msg/Twist',
    'controller/journal': 'std_msgs/msg/Int64MultiArray',
}
"""Topics subscribed to before anybody publishes them, so that their first message is kept."""
LATCHED = ('reference', 'odom', 'controller/journal')
"""Those of them whose publishers, ours, keep what they have said. A recorder that finds them a
moment after the controller did would otherwise lose what the run cannot be computed again from."""


class Attention:
    """Decides which topics the ears are at, and with what quality of service.

    Parameters
    ----------
    node
        Who looks around in the graph.
    selection
        What is wanted.
    ears
        Those that listen.
    take
        Takes in what has been heard so far, before a topic is listened to in another way.
    recorded
        Whether something of a topic has been recorded already.
    """

    def __init__(
        self,
        node: Node,
        selection: Selection,
        ears: Ears,
        take: Callable[[], None],
        recorded: Callable[[str], bool],
    ) -> None:
        self._node = node
        self._selection = selection
        self._ears = ears
        self._take = take
        self._recorded = recorded
        self.left_out: set[str] = set()
        """Topics that are wanted and cannot be recorded."""

    def expect(self) -> None:
        """Listen to what will be there sooner or later."""
        for name, kind in EXPECTED.items():
            topic = self._node.resolve_topic_name(name)
            if not self._selection.wants(topic, [kind]):
                continue
            try:
                latched = name in LATCHED
                self._ears.listen(
                    topic, kind, quality.RECORDED_LATCHED if latched else quality.RECORDED
                )
            except graph.RCLError:
                # A node of this process has it with another type: the publisher will tell.
                continue

    def discover(self) -> None:
        """Listen to what is published and wanted."""
        for topic, kinds in self._node.get_topic_names_and_types():
            if topic in self.left_out or not self._selection.wants(topic, kinds):
                continue
            if publishers := self._node.get_publishers_info_by_topic(topic):
                self._attend(topic, publishers)

    def leave_out(self, topic: str, why: str) -> None:
        """Listen to a topic no longer, and say so."""
        self._ears.stop(topic)
        self.left_out.add(topic)
        self._node.get_logger().warning(f'{topic} is not recorded: {why}')

    def _attend(self, topic: str, publishers: Sequence[TopicEndpointInfo]) -> None:
        kinds = [info.topic_type for info in publishers]
        profiles = [info.qos_profile for info in publishers]
        held = self._ears.ear(topic)
        wanted = quality.to_hear_all(profiles)
        if held and held.kind in kinds:
            # What was latched before this recorder came is heard only by those who ask for it;
            # once something was recorded, asking would bring it twice.
            missed = quality.is_latched(wanted) and not quality.is_latched(held.quality)
            if quality.hears_all(held.quality, profiles) and (not missed or self._recorded(topic)):
                return
        kind = held.kind if held and held.kind in kinds else kinds[0]
        self._take()  # what was heard the old way is kept
        try:
            self._ears.listen(topic, kind, wanted)
        except (ImportError, graph.RCLError) as error:
            self.leave_out(topic, str(error))
