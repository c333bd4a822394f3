# SPDX-License-Identifier: Apache-2.0

"""A scene as RViz shows it: voxels, names and uncertainties of its objects."""

import colorsys
from collections.abc import Sequence

import numpy as np
from geometry_msgs.msg import Point, Vector3
from jaxtyping import Float
from scipy.spatial.transform import Rotation
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker, MarkerArray

from bayes3d_ros.objects.model import Library, ObjectModel
from bayes3d_ros.posterior.types import ObjectEstimate, ScenePosterior
from bayes3d_ros.ros.to_messages import header, pose_message

_TEXT_HEIGHT = 0.02  # metres


class SceneMarkers:
    """Makes marker arrays for the objects of one library."""

    def __init__(self, library: Library) -> None:
        self._models = library.by_name
        self._voxels = {model.name: _voxel_points(model) for model in library.models}

    def __call__(self, posterior: ScenePosterior, ids: Sequence[str] = ()) -> MarkerArray:
        """Markers of one scene; the first one deletes all that were shown before. Ids of markers are labels; `ids` are
        the objects' own.

        Namespaces: `voxels` (surface voxels), `unknown` (boxes of unknown things), `names` (id and p(exists)),
        `uncertainty` (ellipsoid of two standard deviations of the position), `modes` (voxels at the other modes of the
        pose, the lighter the fainter).
        """
        markers = [Marker(header=header(posterior), action=Marker.DELETEALL)]
        above = -posterior.T_pose_camera[:3, 1]  # the camera's y points down
        for label, estimate in enumerate(posterior.objects, start=1):
            pose = pose_message(estimate.position, estimate.orientation)
            solid = self._solid(estimate, label)
            solid.pose = pose
            side = float(np.max(estimate.box(self._models)[1]))

            name = Marker(type=Marker.TEXT_VIEW_FACING, color=ColorRGBA(r=1.0, g=1.0, b=1.0, a=1.0))
            place = estimate.position + (0.5 * side + _TEXT_HEIGHT) * above
            name.pose = pose_message(place, np.array([0.0, 0.0, 0.0, 1.0]))
            name.scale.z = _TEXT_HEIGHT
            called = ids[label - 1] if ids else f"{label} {estimate.type}"
            name.text = f"{called} {estimate.probability:.2f}"

            orientation, axes = principal_axes(estimate.covariance[:3, :3])
            spread = Marker(type=Marker.SPHERE, color=label_colour(label, 0.4))
            spread.pose = pose_message(estimate.position, orientation)
            spread.scale = Vector3(**dict(zip("xyz", (2 * 2 * axes).tolist(), strict=True)))
            for namespace, marker in (
                ("unknown" if estimate.is_unknown else "voxels", solid),
                ("names", name),
                ("uncertainty", spread),
            ):
                marker.header, marker.ns, marker.id, marker.action = header(posterior), namespace, label, Marker.ADD
                markers.append(marker)
            for mode in () if estimate.is_unknown else estimate.modes[1:]:
                other = Marker(type=Marker.CUBE_LIST, color=label_colour(label, 0.8 * mode.weight), scale=solid.scale)
                other.pose, other.points = pose_message(mode.position, mode.orientation), solid.points
                other.header, other.ns, other.id, other.action = header(posterior), "modes", len(markers), Marker.ADD
                markers.append(other)
        return MarkerArray(markers=markers)

    def _solid(self, estimate: ObjectEstimate, label: int) -> Marker:
        """Surface voxels of a model, or the mean box of an unknown thing, a translucent cube on its base."""
        if estimate.size is None:
            model = self._models[estimate.type]
            voxels = Marker(type=Marker.CUBE_LIST, color=label_colour(label, 0.8))
            voxels.scale = Vector3(x=model.voxel_size, y=model.voxel_size, z=model.voxel_size)
            voxels.points = self._voxels[estimate.type]
            return voxels
        x, y, z = (float(side) for side in estimate.size)
        box = Marker(type=Marker.CUBE_LIST, color=label_colour(label, 0.35), scale=Vector3(x=x, y=y, z=z))
        box.points = [Point(x=0.0, y=0.0, z=z / 2)]
        return box


def principal_axes(covariance: Float[np.ndarray, "3 3"]) -> tuple[Float[np.ndarray, "4"], Float[np.ndarray, "3"]]:
    """Quaternion x y z w and standard deviations (at least 0.1 mm, to be seen) along the principal axes."""
    variance, axes = np.linalg.eigh(covariance)
    axes = axes * np.sign(np.linalg.det(axes))
    return Rotation.from_matrix(axes).as_quat(), np.sqrt(np.maximum(variance, 1e-8))


def label_colour(label: int, alpha: float) -> ColorRGBA:
    """A colour per label; neighbours differ most (golden-angle hues)."""
    r, g, b = colorsys.hsv_to_rgb(label * 0.61803398875 % 1.0, 0.75, 0.95)
    return ColorRGBA(r=r, g=g, b=b, a=alpha)


def _voxel_points(model: ObjectModel) -> list[Point]:
    centres = model.origin + (model.surface_index + 0.5) * model.voxel_size
    return [Point(x=float(x), y=float(y), z=float(z)) for x, y, z in centres]
