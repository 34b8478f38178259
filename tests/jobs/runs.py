"""A replay's folder as the command leaves it, for what reads it afterwards."""

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from splatctrl_cli.files.output import part_digests
from splatctrl_cli.robot.model import RobotModel
from tests.cli.replay_desk import Desk
from tests.jobs.stage import FAR, Stage, ball_beside, passing

Runs = Callable[..., Path]


@pytest.fixture
def run(desk: Desk, arm: RobotModel, unpainted: None, monkeypatch: pytest.MonkeyPatch) -> Runs:
    """A replay in which a ball comes near, as the command leaves it; its scene and robot beside it."""

    def made(out: str = "audit", mode: str = "audit", *more: str) -> Path:
        desk.source.states = passing()
        near = ball_beside(arm, passing()[-1].position, 0.012, way=np.array([s.position for s in passing()[:-1]]))
        stage = Stage(desk=desk, arm=arm, balls=(FAR,), later=(near,), later_from=500_000_000)
        scene = desk.folder / "scene"
        if not scene.exists():
            stage.scene()
            patch_json(scene / "run.json", lambda found: found | {"command": "reconstruct", "arguments": []})
        words = ["--scene", "scene", "--urdf", desk.robot[1], "--spheres", desk.robot[3]]
        monkeypatch.setattr(sys, "argv", ["splatctrl", "replay", "fake.mcap", *words, "--mode", mode])
        monkeypatch.chdir(desk.folder)
        desk.replay(*words[:2], "--mode", mode, "-q", *more, out=out)
        cv2.imwrite(str(desk.folder / out / "worst_1.png"), np.full((90, 1200, 3), 200, np.uint8))
        for name in ("clearance", "evidence"):
            (desk.folder / out / f"{name}.png").unlink()
        if mode != "audit":
            for name in ("commands", "divergence"):
                (desk.folder / out / f"{name}.png").unlink(missing_ok=True)
        folder = desk.folder / out
        patch_json(folder / "run.json", lambda found: found | {"parts": part_digests(folder)})
        return folder

    return made


def patch_json(path: Path, change: Callable[[dict[str, Any]], Any]) -> None:
    path.write_text(json.dumps(change(json.loads(path.read_text()))))
