"""Scenes in MVSNet's text form, as the datasets that use it differ: ends of camera files, folders, lengths."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from splatctrl_cli.errors import InputError
from splatctrl_cli.files.image_file import write_pfm
from splatctrl_cli.logs.source_options import SourceOptions
from splatctrl_cli.records import RgbdFrame
from splatctrl_cli.sources.source import open_source
from tests.datasets.make_layout import HEIGHT, WIDTH, K, check, color_of, frames_of, make_mvsnet


@pytest.mark.parametrize("tail", ["0.5 0.01", "0.5 2.5", "0.5 0.01 192", "0.5 0.01 192 2.41", ""])
@pytest.mark.parametrize("images", ["images", "blended_images", "."])
def test_every_end_of_a_camera_file_and_place_of_images_is_read(tmp_path: Path, tail: str, images: str) -> None:
    folder = make_mvsnet(tmp_path, tail=tail, images=images)
    cv2.imwrite(str(folder / images / "00000000_masked.png"), np.zeros((HEIGHT, WIDTH, 3), np.uint8))
    check(frames_of(folder))


def test_lengths_that_can_be_no_metres_are_millimetres_and_that_is_said(tmp_path: Path) -> None:
    source = open_source(make_mvsnet(tmp_path, unit=1e-3, tail="425 2.5 192 933.8"))
    frames = [record for record in source.records() if isinstance(record, RgbdFrame)]
    metres = open_source(make_mvsnet(tmp_path / "m"))
    for frame, same in zip(frames, (r for r in metres.records() if isinstance(r, RgbdFrame)), strict=True):
        assert frame.T_world_camera == pytest.approx(same.T_world_camera, abs=1e-9)
        assert frame.depth == pytest.approx(same.depth, rel=1e-6)
    assert "lengths are taken as millimetres, by a least depth of 425" in source.loss.notes[0]
    assert "lengths are taken as metres, by a least depth of 0.5" in metres.loss.notes[0]


def test_a_depth_scale_moves_depth_and_cameras_alike(tmp_path: Path) -> None:
    source = open_source(make_mvsnet(tmp_path, unit=0.1), SourceOptions(depth_scale=0.1))
    frames = [record for record in source.records() if isinstance(record, RgbdFrame)]
    for frame, same in zip(frames, frames_of(make_mvsnet(tmp_path / "m")), strict=True):
        assert frame.T_world_camera == pytest.approx(same.T_world_camera, abs=1e-9)
        assert frame.depth == pytest.approx(same.depth, rel=1e-6)
    assert source.loss.notes == []


def test_cameras_of_a_quarter_of_the_image_and_depth_of_another_size_are_fitted(tmp_path: Path) -> None:
    folder = make_mvsnet(tmp_path)
    for index in range(3):
        large = cv2.resize(color_of(index)[..., ::-1], (4 * WIDTH, 4 * HEIGHT), interpolation=cv2.INTER_NEAREST)
        cv2.imwrite(str(folder / f"images/{index:08d}.png"), large)
    frame = frames_of(folder)[1]
    assert (frame.intrinsics.fx, frame.intrinsics.cx) == (4 * K[0], 4 * K[2])
    assert frame.depth.shape == (4 * HEIGHT, 4 * WIDTH)
    assert frame.depth[5, 6] == np.float32(1.0 + 0.1 + 0.01 * (WIDTH + 1))


def test_measured_depth_comes_before_that_of_a_network(tmp_path: Path) -> None:
    folder = make_mvsnet(tmp_path, depth="rendered_depth_maps")
    (folder / "depth_est").mkdir()
    for index in range(3):
        write_pfm(folder / f"depth_est/{index:08d}.pfm", np.full((HEIGHT, WIDTH), 7.0, np.float32))
    source = open_source(folder)
    check([record for record in source.records() if isinstance(record, RgbdFrame)])
    assert "depth is that of rendered_depth_maps/, not of depth_est" in source.loss.notes


def test_a_cut_depth_map_is_counted(tmp_path: Path) -> None:
    folder = make_mvsnet(tmp_path)
    file = folder / "depths/00000001_init.pfm"
    file.write_bytes(file.read_bytes()[:-4])
    source = open_source(folder)
    assert (len(list(source.records())), source.loss.damaged) == (2, 1)


def test_a_centre_that_fits_no_image_is_refused(tmp_path: Path) -> None:
    folder = make_mvsnet(tmp_path)
    file = folder / "cams/00000002_cam.txt"
    file.write_text(file.read_text().replace(" 3.5\n", " 31.5\n"))
    with pytest.raises(InputError, match=r"00000002_cam.txt: principal point \(31.5, 2.5\) fits no image of 8x6"):
        open_source(folder)
