"""Quality of service that follows what the publishers of a topic offer."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rcl_interfaces.msg import SetParametersResult
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.subscription import Subscription

from rangeseg_ros.ros.counting import Losses


class MatchedSubscription:
    """A subscription that is reliable where every publisher offers it, else best effort.

    The middleware's own `best_available` policy looks once, when the subscription is made, and
    takes a topic without publishers for a reliable one. Here the choice is made anew when
    publishers come or go; `qos_overrides.<topic>.subscription.reliability` decides where it is
    set. `losses` counts the messages that arrive and those that are lost.
    """

    def __init__(
        self,
        node: Node,
        kind: type,
        topic: str,
        callback: Callable[[Any], None],
        losses: Losses | None = None,
    ) -> None:
        self._node = node
        self._callback = callback
        self._losses = losses or Losses()
        # rclpy's annotation does not know of callbacks that get the message's info as well.
        self._arguments: tuple[type, str, Any] = kind, topic, self._on_message
        self._events = SubscriptionEventCallbacks(
            matched=lambda event: self._on_matched(),
            incompatible_qos=lambda event: self.follow_publishers(),
            message_lost=self._on_lost,
        )
        self._subscription = self._create()

    @property
    def topic(self) -> str:
        """Name of the topic, remapped."""
        return str(self._subscription.topic_name)

    def publishers(self) -> str:
        """How many publishers the topic has, and which of their types are not what is read."""
        kind = self._arguments[0]
        own = f'{kind.__module__.partition(".")[0]}/msg/{kind.__name__}'
        offers = self._node.get_publishers_info_by_topic(self.topic)
        others = sorted({info.topic_type for info in offers} - {own})
        return f'{len(offers)} publishers' + (f' of {", ".join(others)}' if others else '')

    def follow_publishers(self) -> None:
        """Subscribe anew where the publishers there are now offer something else.

        Called by the middleware's events, and to be called now and then: the event of a
        publisher that leaves may come before the list of publishers is without it.
        """
        self._single = self._node.count_publishers(self.topic) == 1
        # A topic that has lost its last publisher keeps its policies for when that comes back.
        best = self._best_offered(self.topic)
        if best and best != self._offered and not self._overridden:
            self.destroy()
            self._subscription = self._create()

    def destroy(self) -> None:
        """Unsubscribe."""
        self._node.destroy_subscription(self._subscription)

    def _on_message(self, message: Any, info: dict[str, Any]) -> None:
        self._losses.arrived(info.get('publication_sequence_number') if self._single else None)
        self._callback(message)

    def _on_matched(self) -> None:
        self._losses.arrived(None)  # the numbers to come may be those of another publisher
        self.follow_publishers()

    def _on_lost(self, event: Any) -> None:
        self._losses.report(event.total_count_change)

    def _create(self) -> Subscription:
        kind, topic, callback = self._arguments
        self._single = True
        # While nobody publishes, what fits any publisher.
        self._offered = self._best_offered(self._node.resolve_topic_name(topic)) or (
            ReliabilityPolicy.BEST_EFFORT,
            DurabilityPolicy.VOLATILE,
        )
        self._overridden = True

        def choose(qos: QoSProfile) -> SetParametersResult:
            if qos.reliability == ReliabilityPolicy.BEST_AVAILABLE:
                self._overridden = False
                qos.reliability, qos.durability = self._offered
            return SetParametersResult(successful=True)

        return self._node.create_subscription(
            kind,
            topic,
            callback,
            QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_AVAILABLE),
            event_callbacks=self._events,
            qos_overriding_options=QoSOverridingOptions.with_default_policies(callback=choose),
        )

    def _best_offered(self, topic: str) -> tuple[ReliabilityPolicy, DurabilityPolicy] | None:
        """The strictest policies that fit every publisher; None when there is none."""
        offers = [info.qos_profile for info in self._node.get_publishers_info_by_topic(topic)]
        reliable = all(offer.reliability == ReliabilityPolicy.RELIABLE for offer in offers)
        latched = all(offer.durability == DurabilityPolicy.TRANSIENT_LOCAL for offer in offers)
        if not offers:
            return None
        return (
            ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
            DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
        )
