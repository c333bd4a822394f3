# SPDX-License-Identifier: Apache-2.0

"""Which topics of a bag frames are made of. All functions raise BagError where there is no such topic, or no one."""

from bayes3d_ros.geometry.compressed_depth import TRANSPORT, is_compressed_depth
from bayes3d_ros.geometry.depth_image import DEPTH_ENCODINGS
from bayes3d_ros.io.bag_contents import CAMERA_INFO, COMPRESSED_IMAGE, IMAGE, POSE, TF, BagContents
from bayes3d_ros.io.mcap_files import BagError

COMPRESSED_DEPTH = f"/{TRANSPORT}"  # at the end of a topic's name


def choose_depth_topic(contents: BagContents, asked: str | None = None) -> str:
    """The topic that is asked for, with or without its /compressedDepth; or the only depth image topic, or the only one
    named image_rect, or else the only one named image_rect_raw. Where a topic was recorded both raw and compressed, the
    raw one."""
    if asked is not None:
        topic = "/" + asked.lstrip("/")
        for name in (topic, topic + COMPRESSED_DEPTH):
            if name in contents.of_type(IMAGE, COMPRESSED_IMAGE):
                return name
        raise BagError(
            f"{contents.bag}: expected a topic {topic} of type {IMAGE}, or {COMPRESSED_IMAGE} (compressedDepth); "
            f"the bag has {contents}"
        )
    candidates = _depth_topics(contents)
    if not candidates:
        known = f"{IMAGE}, {' or '.join(DEPTH_ENCODINGS)}, or {COMPRESSED_IMAGE}, compressedDepth"
        raise BagError(f"{contents.bag}: expected a depth image topic ({known}); the bag has {contents}")
    for ending in ("", "/image_rect", "/image_rect_raw"):
        matching = [topic for base, topic in candidates.items() if base.endswith(ending)]
        if len(matching) == 1:
            return matching[0]
    names = ", ".join(sorted(candidates.values()))
    raise BagError(f"{contents.bag}: expected one depth image topic, choose with --topic: {names}")


def choose_info_topic(contents: BagContents, depth_topic: str) -> str:
    """`camera_info` beside the depth topic, or the only CameraInfo topic."""
    infos = contents.of_type(CAMERA_INFO)
    sibling = depth_topic.removesuffix(COMPRESSED_DEPTH).rsplit("/", 1)[0] + "/camera_info"
    if sibling in infos or len(infos) == 1:
        return sibling if sibling in infos else infos[0]
    has = ", ".join(f"{name} ({msgtype})" for name, msgtype in contents.types.items())
    expected = f"expected {CAMERA_INFO} on {sibling}, or a single such topic (record it with the images)"
    raise BagError(f"{contents.bag}: {expected}; the bag has {has}")


def choose_pose_topic(contents: BagContents, depth_topic: str) -> str | None:
    """The PoseStamped topic named camera_pose, or None; of several, the one that shares most of its namespace with the
    depth topic."""
    poses = [topic for topic in contents.of_type(POSE) if topic.rsplit("/", 1)[-1] == "camera_pose"]
    best = _nearest(poses, depth_topic)
    if len(best) > 1:
        raise BagError(f"{contents.bag}: expected one camera_pose for {depth_topic}, the bag has {', '.join(best)}")
    return best[0] if best else None


def choose_tf_topics(contents: BagContents, depth_topic: str) -> list[str]:
    """/tf and /tf_static, as far as the bag has them; of several, those that share most of their namespace with the
    depth topic."""
    named = [topic for topic in contents.of_type(TF) if topic.rsplit("/", 1)[-1] in ("tf", "tf_static")]
    return sorted(_nearest(named, depth_topic))


def _depth_topics(contents: BagContents) -> dict[str, str]:
    """Topics of depth images by their names without /compressedDepth."""
    found: dict[str, str] = {}
    for topic, image in contents.images.items():
        if contents.types[topic] == IMAGE and image.encoding in DEPTH_ENCODINGS:
            found[topic] = topic
        elif contents.types[topic] == COMPRESSED_IMAGE and is_compressed_depth(image.encoding):
            found.setdefault(topic.removesuffix(COMPRESSED_DEPTH), topic)
    return found


def _nearest(topics: list[str], depth_topic: str) -> list[str]:
    """Those topics that share most leading parts of their namespaces with the depth topic."""
    shared = [_shared_namespace(topic, depth_topic) for topic in topics]
    return [topic for topic, count in zip(topics, shared, strict=True) if count == max(shared)]


def _shared_namespace(a: str, b: str) -> int:
    """How many leading parts of their namespaces two topics share."""
    pairs = list(zip(a.split("/")[:-1], b.split("/")[:-1], strict=False))
    return next((n for n, (x, y) in enumerate(pairs) if x != y), len(pairs))
