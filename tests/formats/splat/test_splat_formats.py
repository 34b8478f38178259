"""What every format of splat files keeps: written, read back within its bound, described, refused where damaged."""

import sys
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest

from splatctrl_cli.errors import UsageError
from splatctrl_cli.formats.splat import usd
from splatctrl_cli.formats.splat.gaussian_ply import SplatFormat, differences, write_gaussian_ply
from splatctrl_cli.formats.splat.splats import (
    FORMATS,
    as_gaussians,
    as_splats,
    describe_splats,
    format_of,
    nearest_splats,
    read_splats,
    write_ply,
)
from splatctrl_cli.recording.source import describe
from splatctrl_cli.records import GaussianSet, SplatSet
from tests.formats.splat.test_gaussian_ply import changed, gaussian_set, splat_set
from tests.refused import expect_refusal


@pytest.fixture(params=FORMATS.values(), ids=FORMATS)
def kind(request: pytest.FixtureRequest) -> SplatFormat:
    """Each format whose library is installed."""
    found: SplatFormat = request.param
    try:
        found.check()
    except UsageError as error:
        pytest.skip(str(error))
    return found


def labelled(num: int, degree: int) -> GaussianSet:
    return replace(gaussian_set(num, degree=degree), labels=(np.arange(num) % 3).astype(np.uint8))


def test_the_same_set_gives_the_same_bytes_and_is_described(tmp_path: Path, kind: SplatFormat) -> None:
    gaussians = gaussian_set(30, degree=0)
    paths = [tmp_path / f"{name}{kind.suffix}" for name in ("a", "b")]
    for path in paths:
        kind.write(path, gaussians, {"k": "v"})
    assert paths[0].read_bytes() == paths[1].read_bytes() and sorted(tmp_path.iterdir()) == paths
    for summary in (describe(paths[0]), describe_splats(paths[0], b"")):
        assert summary.kind == "splats" and 30 in (summary.facts.get("splats"), summary.facts.get("vertex"))
    facts = {"format": kind.name, "shape": "anisotropic", "degree_of_harmonics": 0}
    assert facts.items() <= summary.facts.items()
    np.testing.assert_allclose(np.array(summary.facts["lower_m"]), gaussians.centers.min(axis=0), atol=1e-3)


def test_isotropic_splats_are_read_as_that_from_every_format(tmp_path: Path, kind: SplatFormat) -> None:
    splats = replace(splat_set(200), colors=np.full((200, 3), 0.25, np.float32))
    path, gaussians = tmp_path / f"a{kind.suffix}", as_gaussians(splats)
    kind.write(path, gaussians, {})
    back, _ = read_splats(path)
    assert isinstance(back, SplatSet)
    bound = kind.bound(gaussians)
    np.testing.assert_allclose(back.radii, splats.radii, rtol=bound.sigma + 1e-6)
    np.testing.assert_allclose(back.colors, splats.colors, atol=bound.color + 1e-6)


def test_what_is_no_gaussian_or_no_whole_file_is_refused_in_one_line(tmp_path: Path, kind: SplatFormat) -> None:
    gaussians, path = gaussian_set(5), tmp_path / f"a{kind.suffix}"
    gaussians.centers[3, 1] = np.nan
    expect_refusal("splat 3: center: expected finite, got", kind.write, path, gaussians, {})
    assert not list(tmp_path.iterdir())
    expect_refusal("cannot be read", read_splats, path)
    kind.write(path, gaussian_set(), {})
    content = path.read_bytes()
    for length, read in ((len(content) // 2 - 3, read_splats), (20, read_splats), (20, describe)):
        path.write_bytes(content[:length])
        expect_refusal(f"a{kind.suffix}: ", read, path)


def test_what_lies_outside_a_formats_range_is_held_at_its_edge(tmp_path: Path) -> None:
    gaussians = gaussian_set(2)
    gaussians.scales[0, 1] = 1e-6
    gaussians.harmonics[1, [0, 5], [2, 0]] = 50.0, -3.0
    for suffix in (".splat", ".spz"):
        found = FORMATS[suffix]
        found.write(tmp_path / f"a{suffix}", gaussians, {})
        reduced, back = found.reduce(gaussians), found.read(tmp_path / f"a{suffix}")[0]
        assert not differences(reduced, back).beyond(found.bound(gaussians))
        assert differences(reduced, gaussians).color > 5
    assert (back.scales[0, 1], back.harmonics[1, 5, 0]) == (pytest.approx(np.exp(-10), rel=1e-5), -1.0)


def test_a_difference_beyond_the_bound_is_named() -> None:
    gaussians, bound = gaussian_set(4), FORMATS[".splat"].bound(gaussian_set(4))
    turned = replace(gaussians, quats_wxyz=np.roll(gaussians.quats_wxyz, 1, axis=0))
    assert [line.split()[0] for line in differences(gaussians, turned).beyond(bound)] == ["rotation"]
    assert not differences(gaussians, replace(gaussians, quats_wxyz=-gaussians.quats_wxyz)).beyond(bound)
    broken = replace(gaussians, opacities=np.full(4, np.nan, np.float32))
    assert [line.split()[0] for line in differences(gaussians, broken).beyond(bound)] == ["opacity"]


def test_the_nearest_isotropic_set_keeps_volume_mean_colour_and_opacity() -> None:
    gaussians = changed(gaussian_set(1), scales=[[0.01, 0.02, 0.04]], opacities=[0.3])
    splats = nearest_splats(gaussians)
    assert splats.radii[0] == pytest.approx(0.02, rel=1e-6)
    np.testing.assert_allclose(splats.colors, 0.5 + 0.28209479 * gaussians.harmonics[:, 0], rtol=1e-6)
    assert splats.opacities[0] == np.float32(0.3)
    said = "got 1 of 1 whose scales differ and 1 whose colour depends on the view; "
    expect_refusal(said, as_splats, gaussians, "a.ply")


def test_a_ply_without_rotation_is_read_where_it_is_round_and_refused_where_not(tmp_path: Path) -> None:
    round_splats, path = tmp_path / "round.ply", tmp_path / "a.ply"
    write_ply(round_splats, splat_set(3), {})
    write_gaussian_ply(path, gaussian_set(3), {})
    for file in (round_splats, path):
        file.write_bytes(file.read_bytes().replace(b"float rot_", b"float was_"))
    assert isinstance(read_splats(round_splats)[0], SplatSet)
    expect_refusal("missing properties rot_0 rot_1 rot_2 rot_3", read_splats, path)


def test_an_unknown_suffix_names_the_known_and_a_library_that_lacks_its_remedy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    said = r"a\.{0}: expected a suffix of \.ply, \.splat, \.spz, .*, got \.{0}"
    expect_refusal(said.format("stl"), format_of, Path("a.stl"), error=UsageError)
    expect_refusal(said.format("txt"), read_splats, Path("a.txt"))
    assert format_of(Path("a")) is FORMATS[".ply"]
    monkeypatch.setitem(sys.modules, "pxr", None)
    lacks, given = "usd-core is not installed; pip install 'splatctrl-cli[usd]'", (gaussian_set(1), {})
    expect_refusal(lacks, usd.write_usd, tmp_path / "a.usdc", *given, suffix=".usdc", error=UsageError)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_what_is_written_reads_back_within_a_bound_that_is_not_loose(
    tmp_path: Path, kind: SplatFormat, degree: int
) -> None:
    gaussians, path = labelled(3000, degree), tmp_path / f"a{kind.suffix}"
    kind.write(path, gaussians, {"scene": "made up"})
    back, comments = kind.read(path)
    reduced, bound = kind.reduce(gaussians), kind.bound(gaussians)
    measured = differences(reduced, back)
    assert not measured.beyond(bound) and np.array_equal(back.labels, reduced.labels)
    assert isinstance(read_splats(path)[0], GaussianSet)
    if kind.is_rounded:
        assert degree < 3 or all(asdict(measured)[name] >= 0.7 * most for name, most in asdict(bound).items())
        return
    assert reduced is gaussians and max(asdict(bound).values()) <= 1e-4
    assert (comments["scene"], back.harmonics.shape[1]) == ("made up", (degree + 1) ** 2)
    kind.write(tmp_path / "again", back, {"scene": "made up"})
    assert (tmp_path / "again").read_bytes() == path.read_bytes()
