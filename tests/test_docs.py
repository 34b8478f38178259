"""The documentation says what the code does: generated pages, names of functions, commands and links are checked."""

import ast
import importlib.util
import re
import shlex
from collections.abc import Iterator
from pathlib import Path
from string import Template

import pytest

from splatctrl_cli.cli.main import COMMANDS, build_parser, main
from splatctrl_cli.config import load_config
from splatctrl_cli.evaluate.gates import check_gate_names
from splatctrl_cli.jobs.replay_baseline import read_baselines
from splatctrl_cli.jobs.replay_metrics import metric_names

ROOT = Path(__file__).parent.parent
PAGES = sorted([*ROOT.glob("*.md"), *ROOT.glob("docs/*.md"), *ROOT.glob("sample_data/*.md")])
CODE = re.compile(r"`([^`\n]+)`")
PLACE = re.compile(r"([\w/]+\.(?:py|h|cpp))(?:: (.+))?")
EXAMPLE = ROOT / "docs" / "replay_example.md"
SETTING = re.compile(r"((?:scene|gaussians|occupancy|human|field|control|planner|verdict)\.\w+)(?: = (.+))?")


def generated() -> dict[str, str]:
    spec = importlib.util.spec_from_file_location("generate", ROOT / "docs" / "generate.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    pages: dict[str, str] = module.pages()
    return pages


@pytest.mark.parametrize("name", ["cli.md", "config.md"])
def test_generated_pages_are_what_make_docs_writes_now(name: str) -> None:
    assert (ROOT / "docs" / name).read_text(encoding="utf-8") == generated()[name], "run: make docs"


def test_generated_pages_do_not_depend_on_the_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "40")
    narrow = generated()
    monkeypatch.setenv("COLUMNS", "200")
    assert generated() == narrow


def test_every_option_that_help_shows_is_in_the_page() -> None:
    page = (ROOT / "docs" / "cli.md").read_text(encoding="utf-8")
    sections = dict(re.findall(r"^## (\S+)\n(.*?)(?=^## |\Z)", page, flags=re.DOTALL | re.MULTILINE))
    assert tuple(sections) == COMMANDS
    subparsers = next(a for a in build_parser()._actions if a.dest == "command")
    assert isinstance(subparsers.choices, dict)
    for command, parser in subparsers.choices.items():
        for option in set(re.findall(r"(?<![\w-])--[a-z][a-z-]*", parser.format_help())) - {"--help"}:
            assert option in sections[command], f"{command} {option}"


def places() -> Iterator[tuple[Path, str]]:
    """Every (file, name) that docs/paper.md puts in code marks; the name is empty for a file alone."""
    text = (ROOT / "docs" / "paper.md").read_text(encoding="utf-8")
    for code in CODE.findall(text):
        match = PLACE.fullmatch(code)
        if match:
            path = ROOT / match[1] if match[1].startswith("tests/") else ROOT / "splatctrl_cli" / match[1]
            for name in (match[2] or "").split(", "):
                yield path, name


def names_in(path: Path) -> set[str]:
    """Functions and classes that a file defines, and `Class.method`."""
    text = path.read_text(encoding="utf-8")
    if path.suffix != ".py":
        return set(re.findall(r"^[^\s#/}].*?\b(\w+)\(", text, flags=re.MULTILINE))
    names = set()
    for node in ast.parse(text).body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            names.add(node.name)
        if isinstance(node, ast.ClassDef):
            names |= {f"{node.name}.{item.name}" for item in node.body if isinstance(item, ast.FunctionDef)}
    return names


def test_every_place_that_the_paper_page_names_exists() -> None:
    found = list(places())
    assert len(found) > 100
    missing = [
        f"{path.relative_to(ROOT)}: {name}"
        for path, name in found
        if not path.is_file() or (name and name not in names_in(path))
    ]
    assert missing == []


def test_every_setting_that_the_paper_page_names_can_be_given() -> None:
    text = (ROOT / "docs" / "paper.md").read_text(encoding="utf-8")
    settings = [match for code in CODE.findall(text) if (match := SETTING.fullmatch(code))]
    assert len(settings) > 5
    for match in settings:
        section, key = match[1].split(".")
        assert key in load_config(None, []).as_dict()[section], match[1]
        if match[2]:
            load_config(None, [f"{match[1]}={match[2]}"])


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_link_leads_somewhere(page: Path) -> None:
    for link in re.findall(r"\]\(([^)\s]+)\)", page.read_text(encoding="utf-8")):
        if link.startswith(("http://", "https://")):
            continue
        file, _, heading = link.partition("#")
        target = page if not file else page.parent / file
        assert target.exists(), link
        if heading:
            titles = re.findall(r"^#+ (.+)$", target.read_text(encoding="utf-8"), flags=re.MULTILINE)
            assert heading in {re.sub(r"[^\w -]", "", title).strip().lower().replace(" ", "-") for title in titles}


def commands_on(page: Path) -> list[str]:
    """Command lines of indented or fenced code, continuation lines joined, shell variables as the page sets them."""
    text = page.read_text(encoding="utf-8").replace("\\\n", " ")
    variables: dict[str, str] = {}
    for name, value in re.findall(r'^\$ ([A-Z]+)="(.*)"$', text, flags=re.MULTILINE):
        variables[name] = Template(value).safe_substitute(variables)
    lines = re.findall(r"^(?: {4}|\$ )?(?:\.venv/bin/)?splatctrl ([a-z].*)$", text, flags=re.MULTILINE)
    return [Template(line).safe_substitute(variables) for line in lines]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_command_line_shown_is_one_the_parser_takes(page: Path) -> None:
    for command in commands_on(page):
        build_parser().parse_args(shlex.split(command.split("#")[0]))


def test_the_readme_shows_every_step_and_names_every_command() -> None:
    readme = ROOT / "README.md"
    shown = {command.split()[0] for command in commands_on(readme)}
    assert shown >= {"ingest", "info", "reconstruct", "export", "sdf-bake", "score", "replay"}
    for command in COMMANDS:
        assert f"`{command}`" in readme.read_text(encoding="utf-8")


def shown_after(page: Path) -> list[list[str]]:
    """What a page shows that each of its fenced splatctrl commands printed."""
    text = page.read_text(encoding="utf-8")
    return [
        lines.splitlines() for lines in re.findall(r"^\$ splatctrl .*\n((?:(?![$`]).*\n)*)", text, flags=re.MULTILINE)
    ]


def test_the_replay_example_knows_its_settings_gates_and_figures() -> None:
    commands, shown = commands_on(EXAMPLE), shown_after(EXAMPLE)
    assert len(commands) == len(shown)
    num_figures = 0
    for command, lines in zip(commands, shown, strict=True):
        args = build_parser().parse_args(shlex.split(command))
        if args.command != "replay":
            continue
        load_config(None, args.set)
        baselines = read_baselines(args)
        names = metric_names(args.mode, ("exact", "barrier"), has_truth=args.truth is not None, baselines=baselines)
        check_gate_names(args.require, names)
        for line in lines:
            figure = re.fullmatch(r"([a-z]\w*) +-?[\d.]+(?:e-\d+)?", line)
            if figure:
                assert figure[1] in names, f"{command}: {line}"
                num_figures += 1
    assert num_figures > 15


def test_the_replay_example_shows_what_info_prints(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(ROOT)
    command, lines = commands_on(EXAMPLE)[0], shown_after(EXAMPLE)[0]
    assert main(shlex.split(command)) == 0
    printed = capsys.readouterr().out.splitlines()
    assert len(lines) == 5
    assert [line for line in lines if line not in printed] == []
