# SPDX-License-Identifier: Apache-2.0

"""Requests of a lifecycle manager that do not fit a node's state."""

from lifecycle_msgs.srv import ChangeState
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.lifecycle import Node


def refuse_wrong_transitions(node: Node) -> None:
    """Answer a request by id for a transition that the state does not allow with `success: false`, and one line in the
    log. rclpy does so of labels alone: an id ends the process (rclpy 7.1)."""
    service = node._service_change_state
    change = service.callback

    def answer(request: ChangeState.Request, response: ChangeState.Response) -> ChangeState.Response:
        try:
            return change(request, response)
        except rclpy_implementation.RCLError:
            number, label = node._state_machine.current_state
            node.get_logger().warning(
                f"~/change_state: transition {request.transition.id} is refused, the node is {label} ({number})"
            )
            response.success = False
            return response

    service.callback = answer
