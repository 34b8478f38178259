"""What a folder's run.json says of its files is checked when they are opened."""

import json
from collections.abc import Callable
from pathlib import Path

import pytest

from splatctrl_cli.cli.main import main
from splatctrl_cli.files.output import Parts, Stopwatch, part_digests, sha256, write_run
from splatctrl_cli.formats.scene.scene_folder import SceneFolder, open_scene
from splatctrl_cli.formats.splat.splats import read_ply, read_world_splats, write_ply
from splatctrl_cli.jobs.replay.known_scene import read_grid_scene
from tests.cli.replay_desk import SECOND, splats_of, write_scene
from tests.refused import expect_refusal

BOX = ("--box=-0.1,-0.1,-0.1,0.1,0.1,0.1", "--voxel", "0.02", "--no-report")


def as_written(folder: Path, command: str = "reconstruct") -> Path:
    """The folder with a run.json that knows its files."""
    metrics = {"cameras": ["cam0"], "has_clock": True, "stamp_ns": 2 * SECOND}
    write_run(folder, command=command, config={}, inputs={}, metrics=metrics, stopwatch=Stopwatch())
    return folder


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    sets = [(second * SECOND, splats_of(((0.1 * second, 0.0, 0.0), 0.05))) for second in range(3)]
    return as_written(write_scene(tmp_path / "scene", *sets))


def spoil(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)


def test_every_file_is_known_but_run_json_and_the_checkpoint(scene: Path) -> None:
    (scene / "checkpoint" / "state.npz").write_bytes(b"x")
    digests = part_digests(scene)
    parts = [f"snapshots/00000{i}.{suffix}" for i in range(3) for suffix in ("npz", "ply")]
    assert list(digests) == ["audit.jsonl", "occupancy.npz", "snapshots.csv", *parts, "splats.ply"]
    assert digests["snapshots/000002.npz"] == sha256(scene / "snapshots" / "000002.npz")
    assert json.loads((scene / "run.json").read_text())["parts"].keys() == digests.keys()
    other = scene / "other.ply"
    other.write_bytes(b"x")
    expect_refusal("other.ply: expected a file that its run wrote", Parts.from_folder(other).checked, other)
    for parts in (3, {"splats.ply": 3}):
        without_parts(scene, parts=parts)
        expect_refusal("run.json: parts: expected digests", open_scene(scene).splats)


@pytest.mark.parametrize(
    ("name", "look"),
    [
        ("splats.ply", lambda scene: scene.splats()),
        ("occupancy.npz", lambda scene: scene.occupancy()),
        ("occupancy.npz", lambda scene: scene.known()),
        ("occupancy.npz", lambda scene: scene.unrepresented_at(None)),
        ("snapshots.csv", lambda scene: scene.snapshots),
        ("snapshots/000001.ply", lambda scene: scene.splats_at(SECOND)),
        ("snapshots/000001.npz", lambda scene: scene.snapshots[1].occupancy()),
        ("snapshots/000001.npz", lambda scene: scene.snapshots[1].seen()),
        ("snapshots/000001.npz", lambda scene: scene.unrepresented_at(SECOND)),
    ],
)
def test_a_file_that_was_changed_or_removed_is_refused_by_name(
    scene: Path, name: str, look: Callable[[SceneFolder], object]
) -> None:
    spoil(scene / "snapshots" / "000002.ply")  # only what is opened is looked at
    look(open_scene(scene))
    spoil(scene / name)
    expect_refusal(f"{name}: was changed after it was written.*; make it again", lambda: look(open_scene(scene)))
    if name != "splats.ply":  # without which it is no scene
        (scene / name).unlink()
        expect_refusal(f"{name}: missing, though its run wrote it", lambda: look(open_scene(scene)))


def test_a_table_emptied_or_reversed_is_refused_in_an_old_scene_too_where_it_can_be(scene: Path) -> None:
    table = scene / "snapshots.csv"
    head, *rows = table.read_text().splitlines(keepends=True)
    for lines in ([head], [head, *rows[::-1]]):
        table.write_text("".join(lines))
        expect_refusal("snapshots.csv: was changed", lambda: open_scene(scene).snapshot_at(SECOND))
    without_parts(scene)
    said = "stamp 1000000000 after 2000000000: expected stamps that ascend"
    expect_refusal(said, lambda: open_scene(scene).snapshot_at(SECOND))


def test_a_scene_of_an_older_version_is_read_and_says_so(scene: Path) -> None:
    assert open_scene(scene).parts.digests is not None
    without_parts(scene)
    assert open_scene(scene).parts.digests is None
    assert len(open_scene(scene).splats_at(SECOND)) == 1


def test_an_altered_field_is_refused_and_one_alone_is_read(scene: Path, tmp_path: Path) -> None:
    field, alone = tmp_path / "field", tmp_path / "alone.npz"
    assert main(["sdf-bake", str(scene), "-o", str(field), *BOX, "-q"]) == 0
    names = set(json.loads((field / "run.json").read_text())["parts"])
    assert {"field.npz", "field.json"} <= names
    assert not any(name.startswith("channels") for name in names)
    alone.write_bytes((field / "field.npz").read_bytes())
    for path in (alone, field):
        read_grid_scene(path)
    spoil(field / "field.npz")
    for path in (field, field / "field.npz"):
        expect_refusal("field.npz: was changed", read_grid_scene, path)
    assert main(["sdf-bake", str(scene), "--update", str(field), "-o", str(tmp_path / "new"), *BOX, "-q"]) == 4


@pytest.mark.parametrize(("key", "value", "wanted"), [("units", "mm", "m"), ("frame", "camera_link", "world")])
def test_splats_in_other_units_or_another_frame_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], key: str, value: str, wanted: str
) -> None:
    path, ball = tmp_path / "splats.ply", splats_of(((0.0, 0.0, 0.0), 0.05))
    write_ply(path, ball, {key: value})
    assert main(["sdf-bake", str(path), "-o", str(tmp_path / "field"), *BOX, "-q"]) == 4
    assert f"splats.ply: comment '{key}: {value}': expected {wanted}" in capsys.readouterr().err
    folder = write_scene(tmp_path / "scene", (0, ball))
    for file in (folder / "splats.ply", folder / "snapshots" / "000000.ply"):
        file.write_bytes(path.read_bytes())
    as_written(folder)
    for look in (open_scene(folder).splats, lambda: open_scene(folder).splats_at(0)):
        expect_refusal(f"comment '{key}: {value}'", look)
    assert read_ply(path)[1][key] == value  # who only copies or shows them may


def test_splats_that_name_neither_units_nor_frame_are_taken(tmp_path: Path) -> None:
    write_ply(tmp_path / "a.ply", splats_of(((0.0, 0.0, 0.0), 0.05)), {})
    content = (tmp_path / "a.ply").read_bytes()
    for line in (b"comment frame: world\n", b"comment units: metre\n"):
        assert line in content
        content = content.replace(line, b"")
    (tmp_path / "a.ply").write_bytes(content)
    assert len(read_world_splats(tmp_path / "a.ply")) == 1


def without_parts(scene: Path, **parts: object) -> None:
    """A run.json of an older version, or with other parts."""
    run = json.loads((scene / "run.json").read_text())
    del run["parts"]
    (scene / "run.json").write_text(json.dumps(run | parts))
