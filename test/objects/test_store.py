# SPDX-License-Identifier: Apache-2.0

"""Model files and libraries: what is written is what is read, and bad files are named."""

import dataclasses
import json
import zipfile

import numpy as np
import pytest
import trimesh

from bayes3d_ros.geometry.edges import CONCAVE, CONVEX, WALL
from bayes3d_ros.objects import store
from bayes3d_ros.objects.mesh_import import model_from_mesh
from bayes3d_ros.objects.model import LibraryError
from bayes3d_ros.objects.store import learned_from, load_library, load_model, refuse_existing, save_model


@pytest.fixture(scope="module")
def model():
    mug = trimesh.creation.revolve([[0, 0], [0.04, 0], [0.04, 0.08], [0.036, 0.08], [0.036, 0.004], [0, 0.004]])
    return dataclasses.replace(model_from_mesh(mug, "my_mug-1", 0.005), provenance={"views": [1, 2], "note": "ü"})


def rewrite(path, **changes):
    """Replace arrays of a model file; None removes one."""
    with np.load(path) as file:
        arrays = {**file, **changes}
    np.savez_compressed(path, **{name: value for name, value in arrays.items() if value is not None})


def meta_of(path, **changes):
    with np.load(path) as file:
        meta = json.loads(file["meta"].tobytes()) | changes
    return np.frombuffer(json.dumps(meta).encode(), np.uint8)


def test_round_trip(model, tmp_path):
    path = save_model(model, tmp_path / "new" / "library")
    assert path == tmp_path / "new" / "library" / "my_mug-1.npz"
    read = load_model(path)
    for name in ("name", "voxel_size", "provenance"):
        assert getattr(read, name) == getattr(model, name)
    assert set(model.second_kind) == {WALL, CONVEX, CONCAVE}
    for name in ("occupancy", "surface_index", "second_index", "second_kind"):
        np.testing.assert_array_equal(getattr(read, name), getattr(model, name))
    for name in ("origin", "T_object_box", "box_size", "contact_normal", "contact_height"):
        np.testing.assert_allclose(getattr(read, name), getattr(model, name), atol=1e-12)
    assert len(model.second_index) > 100  # of the thin wall
    for side in ("surface", "second"):
        normal, written = getattr(read, f"{side}_normal"), getattr(model, f"{side}_normal")
        assert np.degrees(np.arccos(np.clip(np.einsum("ij,ij->i", normal, written), -1, 1))).max() < 0.4
        np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1)
        off = getattr(read, f"{side}_offset") - getattr(model, f"{side}_offset")
        assert np.abs(off).max() <= 0.5001 * np.sqrt(3) / 2 * 0.005 / 127


def test_a_file_holds_what_planes_of_a_voxel_are(tmp_path):
    """Of a prism whose sides meet at an angle near the sharpest that makes an edge: rounded normals would not tell."""
    angle = np.radians(72.6)
    outline = [(0, 0), (0.08, 0), (0.04, 0.04 * np.tan(angle))]
    prism = trimesh.creation.extrude_triangulation(np.array(outline), [(0, 1, 2)], 0.05)
    model = model_from_mesh(prism, "prism", 0.003)
    path = save_model(model, tmp_path)
    assert meta_of(path).tobytes().count(b'"format": 2') == 1  # who reads format 1 would take edges for walls
    assert model.at_edge.sum() > 100
    np.testing.assert_array_equal(load_model(path).second_kind, model.second_kind)


def test_files_without_planes_of_second_sides_are_read(model, tmp_path):
    path = save_model(model, tmp_path)
    rewrite(path, back=None, back_normal=None, back_offset=None, back_kind=None)
    rewrite(path, meta=meta_of(path, format=1))
    read = load_model(path)
    assert len(read.second_index) == 0 and len(read.surface_index) == len(model.surface_index)


def test_files_do_not_change_when_read_and_written_again(model, tmp_path):
    first = save_model(model, tmp_path)
    again = save_model(load_model(first), tmp_path / "again")
    assert first.read_bytes() == again.read_bytes()


def test_the_order_of_surface_voxels_does_not_matter(model, tmp_path):
    order = np.random.default_rng(0).permutation(len(model.surface_index))
    fields = ("surface_index", "surface_normal", "surface_offset")
    seconds = np.random.default_rng(1).permutation(len(model.second_index))
    shuffled = dataclasses.replace(
        model,
        **{name: getattr(model, name)[order] for name in fields},
        **{
            f"second_{name}": getattr(model, f"second_{name}")[seconds]
            for name in ("index", "normal", "offset", "kind")
        },
    )
    assert save_model(model, tmp_path / "a").read_bytes() == save_model(shuffled, tmp_path / "b").read_bytes()


def test_a_mug_at_5_mm_takes_at_most_16_kb_without_pickle(model, tmp_path):
    path = save_model(model, tmp_path)
    assert path.stat().st_size <= 16_000
    with np.load(path, allow_pickle=False) as file:
        assert all(file[name].dtype.kind in "iuf" for name in file.files)


def test_a_failed_write_leaves_the_old_model_and_no_rubbish(model, tmp_path, monkeypatch):
    path = save_model(model, tmp_path)
    before = path.read_bytes()

    def full(*_args, **_kwargs):
        raise OSError("no space left on device")

    monkeypatch.setattr(store, "write_arrays", full)
    with pytest.raises(OSError):
        save_model(model, tmp_path, replace=True)
    assert path.read_bytes() == before and list(tmp_path.iterdir()) == [path]


def test_an_older_model_is_replaced_only_where_told(model, tmp_path):
    path = save_model(model, tmp_path)
    before, changed = path.read_bytes(), dataclasses.replace(model, provenance={"views": [3]})
    with pytest.raises(LibraryError, match=r"my_mug-1\.npz: a model of this name exists already; --replace") as error:
        save_model(changed, tmp_path)
    assert "\n" not in str(error.value)
    assert path.read_bytes() == before and list(tmp_path.iterdir()) == [path]
    save_model(changed, tmp_path, replace=True)
    assert load_model(path).provenance == {"views": [3]} and list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("hard_links", [True, False])
def test_a_model_written_meanwhile_is_not_lost(model, tmp_path, monkeypatch, hard_links):
    path, write = tmp_path / "my_mug-1.npz", store.write_arrays

    def overtaken(file, arrays):
        write(file, arrays)
        path.write_text("of another process")

    monkeypatch.setattr(store, "write_arrays", overtaken)
    if not hard_links:
        monkeypatch.setattr("os.link", lambda *_: (_ for _ in ()).throw(PermissionError("no hard links here")))
    with pytest.raises(LibraryError, match="exists already"):
        save_model(model, tmp_path)
    assert path.read_text() == "of another process" and list(tmp_path.iterdir()) == [path]


def test_a_file_system_without_hard_links_will_do(model, tmp_path, monkeypatch):
    monkeypatch.setattr("os.link", lambda *_: (_ for _ in ()).throw(PermissionError("no hard links here")))
    path = save_model(model, tmp_path)
    assert load_model(path).name == "my_mug-1" and list(tmp_path.iterdir()) == [path]


def test_what_exists_is_refused_by_name_before_work_begins(model, tmp_path):
    refuse_existing(tmp_path / "no" / "library", "mug")
    path = save_model(model, tmp_path)
    refuse_existing(tmp_path, "mug", "bowl")
    (tmp_path / "mug.npz").touch()
    with pytest.raises(LibraryError) as error:
        refuse_existing(tmp_path, "mug", "bowl", "my_mug-1")
    assert str(error.value).startswith(f"{tmp_path / 'mug.npz'}, {path}: models of these names exist already")


@pytest.mark.parametrize(
    "provenance, stamps",
    [
        ({"kind": "mesh"}, set()),
        ({"kind": "views", "views": [{"stamp_ns": 3}, {"stamp_ns": 5}]}, {3, 5}),
        ({"kind": "views"}, set()),
        ({"kind": "views", "views": None}, set()),
        ({"kind": "views", "views": ["3", {"stamp_ns": "5"}, {}]}, set()),
    ],
)
def test_the_views_of_a_model_are_those_that_its_file_tells(model, provenance, stamps):
    assert learned_from(dataclasses.replace(model, provenance=provenance)) == stamps


def test_library_is_sorted_by_the_names_inside_the_files(model, tmp_path):
    for name, stem in (("b", "1"), ("C", "2"), ("a", "3")):
        save_model(dataclasses.replace(model, name=name), tmp_path).rename(tmp_path / f"{stem}.npz")
    (tmp_path / "README.md").write_text("not a model")
    (tmp_path / ".b-x.tmp").write_text("left behind")
    assert load_library(tmp_path).names == ("C", "a", "b")


def test_missing_and_empty_libraries(tmp_path):
    with pytest.raises(LibraryError, match="no such library folder"):
        load_library(tmp_path / "nowhere")
    with pytest.raises(LibraryError, match="holds no models"):
        load_library(tmp_path)
    with pytest.raises(LibraryError, match="no such model file"):
        load_model(tmp_path / "a.npz")
    (tmp_path / "a.npz").mkdir()
    with pytest.raises(LibraryError, match=r"a\.npz: expected a model file, this is a folder"):
        load_library(tmp_path)
    (tmp_path / "file").write_text("")
    with pytest.raises(LibraryError, match="file: expected a library folder, this is a file"):
        load_library(tmp_path / "file")


def test_two_models_of_one_name(model, tmp_path):
    save_model(model, tmp_path).rename(tmp_path / "copy.npz")
    save_model(model, tmp_path)
    with pytest.raises(LibraryError, match="my_mug-1.npz: a model named my_mug-1 is also in copy.npz"):
        load_library(tmp_path)


def test_damaged_files(model, tmp_path):
    path = save_model(model, tmp_path)
    whole = path.read_bytes()
    middle = len(whole) // 2
    damaged = bytearray(whole)
    damaged[middle : middle + 40] = bytes(40)
    for content in (b"", b"PK", b"hello", whole[:100], whole[:middle], whole[:-1], bytes(damaged)):
        path.write_bytes(content)
        with pytest.raises(LibraryError, match="corrupt or not a model file") as error:
            load_library(tmp_path)
        assert str(path) in str(error.value) and "\n" not in str(error.value)


def test_a_pickled_array_is_refused(model, tmp_path):
    path = save_model(model, tmp_path)
    rewrite(path, frames=np.array([{"a": 1}], dtype=object))
    with pytest.raises(LibraryError, match="corrupt or not a model file"):
        load_model(path)


def test_a_plain_array_is_refused(tmp_path):
    with (tmp_path / "a.npz").open("wb") as file:
        np.save(file, np.zeros(3))
    with pytest.raises(LibraryError, match="corrupt or not a model file"):
        load_model(tmp_path / "a.npz")


@pytest.mark.parametrize(
    "changes, reason",
    [
        ({"frames": None}, "the field 'frames' is missing"),
        ({"meta": None}, "the field 'meta' is missing"),
        ({"frames": np.zeros(23)}, "frames must hold 24 numbers"),
        ({"shape": np.array([2, 2])}, "shape must be three positive"),
        ({"shape": np.array([2, 2, -2])}, "shape must be three positive"),
        ({"shape": np.array([2**31 - 1] * 3)}, "shape may have 16777215 voxels at most"),
        ({"shape": np.array([2.0, np.inf, 2.0])}, "shape must be of type integer, got float64"),
        ({"occupancy": np.zeros(3, np.uint8)}, "occupancy must hold"),
        ({"surface_normal": np.zeros((3, 4), complex)}, "surface_normal must be of type int8, got complex128"),
        ({"frames": np.full(24, 1e308)}, r"origin holds 1e\+308, expected 100000 at most"),
        ({"contact_normal": np.full((6, 3), 1e308)}, "contact_normal holds"),
        ({"meta": np.frombuffer(b"[" * 100_000, np.uint8)}, "meta"),
        ({"surface_normal": np.zeros((3, 4), np.int8)}, "must describe"),
        ({"surface_offset": np.zeros(4, np.int8)}, "must describe"),
        ({"back": np.zeros(2, np.uint8)}, "back must hold"),
        ({"back_offset": np.zeros(4, np.int8)}, "back_normal and back_offset must describe"),
        ({"back_kind": np.zeros(4, np.uint8)}, "back_kind must describe"),
        ({"back_normal": None}, "the field 'back_normal' is missing"),
        ({"contact_normal": np.zeros((5, 3))}, "contact_normal must have shape"),
        ({"contact_normal": np.zeros((6, 3))}, "contact_normal must hold unit vectors"),
        ({"frames": np.full(24, np.nan)}, "not finite"),
        ({"meta": np.frombuffer(b"not json", np.uint8)}, "meta"),
        ({"meta": np.frombuffer(b"[1]", np.uint8)}, "meta"),
    ],
)
@pytest.mark.usefixtures("unchecked")
def test_wrong_fields_are_named(model, tmp_path, changes, reason):
    path = save_model(model, tmp_path)
    rewrite(path, **changes)
    with pytest.raises(LibraryError, match=reason) as error:
        load_model(path)
    assert str(path) in str(error.value) and "\n" not in str(error.value)


@pytest.mark.parametrize(
    "changes, reason",
    [
        ({"format": 99}, "format version 99, expected 1 or 2"),
        ({"name": "../etc"}, "name must be made of"),
        ({"name": "a.b"}, "name must be made of"),
        ({"name": ""}, "name must be made of"),
        ({"name": 3}, "name must be made of"),
        ({"voxel_size": -1.0}, "voxel_size must be positive"),
        ({"voxel_size": "wide"}, "voxel_size"),
        ({"voxel_size": 5e-324}, "voxel_size must be positive, 1e-06 to 100000 m"),
        ({"provenance": 3}, "provenance must be"),
    ],
)
@pytest.mark.usefixtures("unchecked")
def test_wrong_meta_is_named(model, tmp_path, changes, reason):
    path = save_model(model, tmp_path)
    rewrite(path, meta=meta_of(path, **changes))
    with pytest.raises(LibraryError, match=reason):
        load_model(path)


@pytest.mark.parametrize(
    "changes, reason",
    [
        ({"name": "a b"}, "name must be made of"),
        ({"occupancy": np.zeros((4, 4, 4), bool)}, "occupancy"),
        ({"box_size": np.array([0.1, 0.0, 0.1])}, "box_size"),
        ({"T_object_box": np.diag([1.0, 1, -1, 1])}, "rigid"),
        ({"origin": np.zeros(4)}, "origin must have shape"),
        ({"second_index": np.full((1, 3), -1)}, "second_normal must have shape"),
        (
            {
                "second_index": np.full((1, 3), 99),
                "second_normal": np.eye(3)[:1],
                "second_offset": np.zeros(1),
                "second_kind": np.zeros(1, np.uint8),
            },
            "second_index",
        ),
    ],
)
@pytest.mark.usefixtures("unchecked")
def test_models_are_checked_when_made(model, changes, reason):
    with pytest.raises(ValueError, match=reason):
        dataclasses.replace(model, **changes)


def test_a_zip_with_foreign_entries_is_refused(tmp_path):
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as file:
        file.writestr("photo.jpg", b"1234")
    with pytest.raises(LibraryError):
        load_library(tmp_path)


@pytest.mark.parametrize(
    "header",
    [
        b"{'descr': '|u1', 'fortran_order': False, 'shape': (1000000000000,), }",
        b"{'descr': '|u1', 'fortran_order': False, 'shape': (1000000000000000000,), }",
        b"{'descr': '|u1', 'fortran_order': False, 'shape': (4,), ",
        b"{'descr': '|u1, 'fortran_order': False, 'shape': (4,), }",
        b"\x00\xff(",
    ],
)
def test_a_header_that_lies_is_one_line(tmp_path, header):
    entry = b"\x93NUMPY\x01\x00" + (len(header) + 1).to_bytes(2, "little") + header + b"\n" + bytes(4)
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as file:
        file.writestr("meta.npy", entry)
    with pytest.raises(LibraryError, match="a.npz: corrupt or not a model file") as error:
        load_model(tmp_path / "a.npz")
    assert "\n" not in str(error.value)


def test_a_file_that_unpacks_to_more_than_any_model_is_not_unpacked(tmp_path):
    with zipfile.ZipFile(tmp_path / "a.npz", "w", zipfile.ZIP_DEFLATED) as file, file.open("meta.npy", "w") as entry:
        for _ in range(17):
            entry.write(bytes(2**24))
    with pytest.raises(LibraryError, match="a.npz: .* bytes, expected 268435456 at most"):
        load_model(tmp_path / "a.npz")


@pytest.mark.filterwarnings("error")
def test_damage_of_any_kind_is_one_line(model, tmp_path):
    """150 damaged copies; whichever can still be read is a model."""
    path, rng = save_model(model, tmp_path), np.random.default_rng(0)
    whole = path.read_bytes()
    with np.load(path) as file:
        fields = {name: file[name] for name in file.files}
    refused = 0
    for k in range(150):
        if k % 3:
            path.write_bytes(damaged_bytes(whole, rng))
        else:
            np.savez(path, **damaged_fields(fields, rng))
        try:
            load_library(tmp_path)
        except LibraryError as error:
            assert str(path) in str(error) and "\n" not in str(error)
            refused += 1
    assert refused > 120


def damaged_bytes(whole, rng):
    """Some bytes changed, cut out, repeated, or everything from somewhere on left out."""
    a, b = np.sort(rng.integers(len(whole), size=2))
    kinds = (whole[:a], whole[:a] + whole[b:], whole[:b] + whole[a:], whole[:a] + rng.bytes(9) + whole[a + 9 :])
    return kinds[rng.integers(4)]


def damaged_fields(fields, rng):
    """One of the arrays missing, of another type or shape, or with a value that cannot be."""
    fields = dict(fields)
    name = rng.choice(sorted(fields))
    array = fields.pop(name)
    wrong = array.astype(float)
    wrong.flat[rng.integers(wrong.size)] = rng.choice([np.nan, np.inf, -1e308, 5e-324])
    others = [array.astype(complex), array.astype("U3"), array.ravel()[:-1], np.array(5), array[None], wrong]
    kind = rng.integers(len(others) + 1)
    return fields if kind == len(others) else fields | {str(name): others[kind]}
