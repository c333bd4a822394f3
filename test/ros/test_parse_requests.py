# SPDX-License-Identifier: Apache-2.0

"""Which image answers which request, without ROS."""

from bayes3d_ros.ros.parse_requests import ParseAnswer, ParseRequests

FOUND, LATE = ParseAnswer(True, "1 object"), ParseAnswer(False, "no result within 10 s")


def test_an_image_serves_all_requests_before_it_and_none_after() -> None:
    requests = ParseRequests()
    first, second = requests.add(1.0, 10.0), requests.add(2.0, 10.0)
    assert not requests.want(0.5) and not requests.want(1.0) and requests.want(1.5)
    third = requests.add(3.0, 10.0)
    assert requests.take(2.5) == (first, second)
    assert not requests.want(2.8) and requests.want(3.5)  # the third came while that image was being parsed
    requests.settle((first, second), FOUND)
    assert (first.answer, second.answer, third.answer) == (FOUND, FOUND, None)
    assert requests.count == 1 and requests.take(3.5) == (third,) and requests.take(4.0) == ()


def test_a_request_is_overdue_whether_its_image_came_or_not_and_its_first_answer_counts() -> None:
    requests = ParseRequests()
    taken = requests.add(0.0, 10.0)
    assert requests.take(1.0) == (taken,)
    waiting = requests.add(2.0, 10.0)
    assert (
        requests.overdue(9.9) == ()
        and requests.overdue(10.0) == (taken,)
        and requests.overdue(12.0)
        == (
            taken,
            waiting,
        )
    )
    requests.settle((taken, waiting), LATE)
    requests.settle((taken,), FOUND)  # the parse ends after all
    assert taken.answer == waiting.answer == LATE and requests.count == 0


def test_all_can_be_refused() -> None:
    requests = ParseRequests()
    every = [requests.add(0.0, 10.0) for _ in range(3)]
    requests.take(1.0)
    refusal = ParseAnswer(False, "the node was deactivated")
    requests.settle_all(refusal)
    assert [request.answer for request in every] == 3 * [refusal] and not requests.want(2.0)
