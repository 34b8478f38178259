"""LeRobot datasets as a preset of [states]: an episode's file and its columns.

Versions 2 and 3 (huggingface/lerobot, lerobot_dataset.py, utils.py) list features in ``meta/info.json``. v2 has
``data/chunk-000/episode_000000.parquet`` per episode; v3 shares ``data/chunk-000/file-000.parquet`` by column
``episode_index``. ``observation.state`` is position, ``timestamp`` seconds from the
episode's begin.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from splatctrl_cli.errors import InputError
from splatctrl_cli.formats.arrays import ParquetFile
from splatctrl_cli.recording.folder.layout import read_json

INFO, POSITION, EPISODE = Path("meta/info.json"), "observation.state", "episode_index"


def is_lerobot(path: Path) -> bool:
    return (path / INFO).is_file() and (path / "data").is_dir()


def preset(folder: Path, episode: int | None) -> Mapping[str, Any]:
    """An episode's keys of [states], by default the only one. Raises InputError."""
    info = read_json(folder / INFO)
    try:
        feature, num = info["features"][POSITION], int(info["total_episodes"])
        size, said = int(feature["shape"][0]), feature.get("names")
        lists = said.values() if isinstance(said, dict) else [said or []]  # by kind, as {"motors": [...]}
        names = [
            str(name).removesuffix(".pos") for names in lists for name in names
        ]  # shoulder_pan.pos is shoulder_pan
    except (KeyError, TypeError, ValueError, IndexError) as error:
        raise InputError(
            f"{folder / INFO}: expected total_episodes and the feature {POSITION}, got no usable {error}",
            remedy="describe the columns in a .toml (splatctrl help replay, Logs)",
        ) from None
    if episode is None and num != 1:
        raise InputError(f"{folder}: {num} episodes", remedy="choose one in a .toml: [states] preset, file, episode")
    found = {"time": "timestamp", "position": [POSITION], "episode": episode or 0}
    return (
        found
        | ({"joints": names} if len(names) == size else {})
        | {"file": str(_file(folder, episode or 0).absolute())}
    )


def _file(folder: Path, episode: int) -> Path:
    files = sorted((folder / "data").glob("*/*.parquet"))
    of_one = [file for file in files if file.stem == f"episode_{episode:06d}"]
    shared = (file for file in files if file.stem.startswith("file") and len(ParquetFile(file, (EPISODE, episode))))
    found = next(iter(of_one), None) or next(shared, None)
    if found is None:
        raise InputError(f"{folder}: no episode {episode}", remedy="copy the whole dataset, or give another episode")
    return found
