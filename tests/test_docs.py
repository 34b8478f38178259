"""The documentation says what the code does: tables, help, names of functions, commands and links are checked."""

import argparse
import ast
import importlib.util
import re
import shlex
from collections.abc import Iterator
from pathlib import Path
from string import Template

import pytest

from experiments.__main__ import EXPERIMENTS
from splatctrl_cli.cli.commands import COMMANDS, build_parser
from splatctrl_cli.cli.main import main
from splatctrl_cli.cli.parser import GONE
from splatctrl_cli.config import PRESETS, load_config
from splatctrl_cli.evaluate.verdict import check_gate_names
from splatctrl_cli.jobs.replay.metrics import metric_scales

ROOT = Path(__file__).parent.parent
PAGES = sorted([*ROOT.glob("*.md"), *ROOT.glob("docs/*.md"), *ROOT.glob("sample_data/*.md")])
CODE = re.compile(r"`([^`\n]+)`")
PLACE = re.compile(r"([\w/]+\.(?:py|h|cpp))(?:: (.+))?")
FOREIGN = {  # options of other programs
    "benchmarks.md": {"--demo"},
    "gpu.md": {"--probe"},
    "reliability.md": {"--always-decode-chunk"},
}
EXAMPLE = ROOT / "docs" / "start.md"
USERS_OWN = {  # what stands for a user's data in commands that are shown; the commands of a page without any are run
    *(
        "LOG",
        "log.mcap",
        "cameras.mcap",
        "joints.mcap",
        "run.capture",
        "X.capture",
        "X.mcap",
        "scene.toml",
        "truth.json",
    ),
    *("old/audit", "new/audit", "old_batch", "baseline.toml", "audit/", "batch/"),
    *("scene", "scene/", "scenes/", "dtu/", "robot.urdf", "spheres.yaml", "panda.urdf"),
}
TOO_LONG = {  # for a test: minutes; the page has their figures
    "reconstruct docs/examples/apc_shelf.toml --root SCENE --max-splats 10000 -o shelf",
    "sweep demo_output/audit --over KEY=A:B",
    "score shelf --reference docs/examples/apc_shelf.toml --root SCENE",
}
RUN_BY_GOLDEN = ("README.md", "start.md")  # all their commands: tests/tools/test_golden.py
SETTING = re.compile(r"((?:scene|occupancy|human|field|control|planner|verdict)\.\w+)(?: = (.+))?")


def test_every_list_of_a_registry_is_what_make_docs_writes_now() -> None:
    spec = importlib.util.spec_from_file_location("generate", ROOT / "docs" / "generate.py")
    generate = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(generate)
    pages: dict[str, str] = generate.pages()
    for name, text in pages.items():
        assert (ROOT / "docs" / name).read_text(encoding="utf-8") == text, f"{name}: run: make docs"
    assert {name for text in pages.values() for _, name, _ in generate.ROWS.findall(text)} == {*generate.LISTS}


@pytest.mark.parametrize("command", COMMANDS)
def test_help_has_every_option_of_a_command_at_any_width(
    command: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    parsers = {parser.prog: parser for parser in leaves(build_parser()) if parser.prog.split()[1] == command}
    for name, parser in parsers.items():
        shown = set()
        for columns in ("40", "200"):
            monkeypatch.setenv("COLUMNS", columns)
            with pytest.raises(SystemExit):
                main([*name.split()[1:], "--help-all"])
            shown.add("".join(capsys.readouterr().out.split()))
        (text,) = shown  # only the line breaks depend on the terminal
        for action in parser._actions:
            assert all(option in text for option in action.option_strings)
            meaning = parser._get_formatter()._expand_help(action)
            assert "".join(meaning.split()) in text, f"{name}: {meaning}"
    if not (ROOT / "docs" / f"{command}.md").exists():
        (parser,) = parsers.values()
        assert main(["help", command]) == 0
        assert capsys.readouterr().out == parser.format_full_help()


def leaves(parser: argparse.ArgumentParser) -> Iterator[argparse.ArgumentParser]:
    """The parsers that take options: of commands, and of the actions of those that have some."""
    nested = [choice for a in parser._actions if isinstance(a.choices, dict) for choice in a.choices.values()]
    yield from (leaf for below in nested for leaf in leaves(below)) if nested else (parser,)


def options_in(text: str) -> set[str]:
    """What a page's code marks name that looks like an option of splatctrl."""
    marked = [code for code in CODE.findall(text) if not code.startswith(("python ", "pip "))]
    return {option for code in marked for option in re.findall(r"(?<![\w-])--[a-z][\w-]*", code)}


def of_experiments() -> set[str]:
    """The options of ``python -m experiments``."""
    parser = argparse.ArgumentParser(conflict_handler="resolve")
    for experiment in EXPERIMENTS.values():
        experiment.add_options(parser)
    return {*parser._option_string_actions}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_option_that_a_page_names_is_one_that_a_command_takes(page: Path) -> None:
    taken = {
        option for leaf in leaves(build_parser()) for action in leaf._actions for option in action.option_strings
    }
    assert len(taken) > 100
    left = {word for words in GONE for word in words.split() if word.startswith("--")}
    more = {"CHANGELOG.md": left | of_experiments(), "study.md": of_experiments()} | FOREIGN
    assert options_in(page.read_text(encoding="utf-8")) <= taken | more.get(page.name, set())


def places() -> Iterator[tuple[Path, str]]:
    """Every (file, name) that the pages of equations put in code marks; the name is empty for a file alone."""
    text = "".join((ROOT / "docs" / name).read_text(encoding="utf-8") for name in ("paper.md", "separation.md"))
    for code in CODE.findall(text):
        match = PLACE.fullmatch(code)
        if match:
            for name in (match[2] or "").split(", "):
                yield ROOT / match[1], name


def names_in(path: Path) -> set[str]:
    """Functions and classes that a file defines, and `Class.method`."""
    text = path.read_text(encoding="utf-8")
    if path.suffix != ".py":
        return set(re.findall(r"^[^\s#/}].*?\b(\w+)\(", text, flags=re.MULTILINE))
    defined = [node for node in ast.parse(text).body if isinstance(node, ast.FunctionDef | ast.ClassDef)]
    methods = {
        f"{node.name}.{item.name}"
        for node in defined
        if isinstance(node, ast.ClassDef)
        for item in node.body
        if isinstance(item, ast.FunctionDef)
    }
    return methods | {node.name for node in defined}


def test_every_place_that_the_paper_page_names_exists() -> None:
    found = list(places())
    assert len(found) > 100
    names = {path: names_in(path) | {""} for path, _ in found if path.is_file()}
    assert [f"{path.relative_to(ROOT)}: {name}" for path, name in found if name not in names.get(path, ())] == []


def test_every_setting_that_the_paper_page_names_can_be_given() -> None:
    text = (ROOT / "docs" / "paper.md").read_text(encoding="utf-8")
    settings = [match for code in CODE.findall(text) if (match := SETTING.fullmatch(code))]
    assert len(settings) > 5
    for match in settings:
        section, key = match[1].split(".")
        assert key in load_config(None, []).as_dict()[section], match[1]
        if match[2]:
            load_config(None, [f"{match[1]}={match[2]}"])


def test_the_preset_of_the_paper_is_what_the_page_of_departures_says() -> None:
    text = (ROOT / "docs" / "paper.md").read_text(encoding="utf-8")
    departures = re.sub(
        r"### The baseline.*?(?=^### )", "", text.split("## Departures")[1], flags=re.DOTALL | re.MULTILINE
    )
    settings = re.findall(r"As\s+printed:\s(.+?)\s`(?:tests|experiments)/", departures, flags=re.DOTALL)
    codes = [code for text in settings for code in CODE.findall(text)]
    said = {match[1]: match[2] for code in codes if (match := SETTING.fullmatch(code)) and match[2]}
    preset = load_config(None, ["preset=paper"])
    assert load_config(None, [f"{key}={value}" for key, value in said.items()]) == preset
    assert {f"{section}.{key}" for section, values in PRESETS["paper"].items() for key in values} <= said.keys()


def without_code(text: str) -> str:
    """A page's text without its fenced code, whose comments look like headings."""
    return re.sub(r"^```.*?^```$", "", text, flags=re.DOTALL | re.MULTILINE)


def links_on(page: Path) -> list[str]:
    """The targets of a page's links and pictures that lie in the repository."""
    links = re.findall(r"\]\(([^)\s]+)\)", without_code(page.read_text(encoding="utf-8")))
    return [link for link in links if not link.startswith(("http://", "https://"))]


def anchors_on(page: Path) -> set[str]:
    """What a link to a heading of the page is called where the code is hosted; the second of a name ends in -1."""
    anchors: list[str] = []
    for title in re.findall(r"^#+ (.+)$", without_code(page.read_text(encoding="utf-8")), flags=re.MULTILINE):
        anchor = re.sub(r"[^\w -]", "", title).strip().lower().replace(" ", "-")
        num_before = sum(bool(re.fullmatch(rf"{re.escape(anchor)}(-\d+)?", other)) for other in anchors)
        anchors.append(f"{anchor}-{num_before}" if num_before else anchor)
    return set(anchors)


def is_broken(page: Path, link: str) -> bool:
    """The file of a page's link, or the heading in it, is not there."""
    file, _, heading = link.partition("#")
    target = page.parent / file if file else page
    return not target.exists() or bool(heading and heading not in anchors_on(target))


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_link_leads_to_a_file_and_a_heading_that_are_there(page: Path) -> None:
    assert [link for link in links_on(page) if is_broken(page, link)] == []


def test_the_index_leads_to_every_page_and_the_pages_to_every_picture_and_table() -> None:
    listed = {(ROOT / "docs" / link.partition("#")[0]).resolve() for link in links_on(ROOT / "docs" / "README.md")}
    assert set(ROOT.glob("docs/*.md")) - listed == {ROOT / "docs" / "README.md"}
    linked = {(page.parent / link).resolve() for page in PAGES for link in links_on(page)}
    assert {*ROOT.glob("docs/images/*"), *ROOT.glob("docs/*.csv")} - linked == set()


def test_every_page_and_heading_that_the_code_names_is_there() -> None:
    named = [
        (path.relative_to(ROOT), *found)
        for folder in ("splatctrl_cli", "benchmarks", "tools", "tests")
        for path in ROOT.glob(f"{folder}/**/*.py")
        for found in re.findall(r"\bdocs/([a-z]+\.md|\w+\.csv)(?:, ([A-Z]\w+))?", path.read_text(encoding="utf-8"))
    ]
    assert len(named) > 20
    for path, page, heading in named:
        assert (ROOT / "docs" / page).is_file(), f"{path}: {page}"
        assert not heading or heading.lower() in anchors_on(ROOT / "docs" / page), f"{path}: {page}, {heading}"


def test_what_a_message_points_to_is_in_a_wheel_too() -> None:
    """A wheel has no docs/ where it is used: ``splatctrl help PAGE`` prints the page."""
    num_named = 0
    for path in ROOT.glob("splatctrl_cli/**/*.py"):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        bare = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}  # docstrings
        texts = [
            node.value
            for node in ast.walk(tree)
            if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in bare
        ]
        assert not [text for text in texts if re.search(r"\bdocs/\w+\.md", text)], path
        for page, heading in re.findall(r"splatctrl help ([a-z]+)(?:, ([A-Z]\w+))?", "\n".join(texts)):
            num_named += 1
            assert (ROOT / "docs" / f"{page}.md").is_file(), f"{path}: {page}"
            assert not heading or heading.lower() in anchors_on(ROOT / "docs" / f"{page}.md"), f"{path}: {heading}"
    assert num_named > 25
    assert "docs/*.md" in (ROOT / "CMakeLists.txt").read_text(), "the wheel's copy"


def commands_on(page: Path) -> list[str]:
    """Command lines of indented or fenced code, continuation lines joined, shell variables as the page sets them."""
    text = page.read_text(encoding="utf-8").replace("\\\n", " ")
    variables: dict[str, str] = {}
    for name, value in re.findall(r'^(?: {4}|\$ )([A-Z]+)="(.*)"$', text, flags=re.MULTILINE):
        variables[name] = Template(value).safe_substitute(variables)
    lines = re.findall(r"^(?: {4}|\$ )?(?:\.venv/bin/)?splatctrl ([a-z].*)$", text, flags=re.MULTILINE)
    return [Template(line).safe_substitute(variables) for line in lines]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_command_line_shown_is_one_the_parser_takes(page: Path) -> None:
    for command in commands_on(page):
        build_parser().parse_args(shlex.split(command.split("#")[0]))


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_command_line_shown_is_run_or_waits_for_the_users_data(page: Path) -> None:
    shown = [shlex.split(command, comments=True) for command in commands_on(page)]
    not_run = [words for words in shown if not USERS_OWN & set(words) and shlex.join(words) not in TOO_LONG]
    assert not_run == [] or page.name in RUN_BY_GOLDEN


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


def test_the_first_page_knows_its_settings_gates_and_figures() -> None:
    commands, shown = commands_on(EXAMPLE), shown_after(EXAMPLE)
    assert len(commands) == len(shown)
    num_figures = 0
    for command, lines in zip(commands, shown, strict=True):
        args = build_parser().parse_args(shlex.split(command))
        if args.command != "replay":
            continue
        load_config(None, args.set)
        names = metric_scales(args.mode, ("exact", "barrier"), has_truth=args.truth is not None)
        check_gate_names(args.require, names)
        for line in lines:
            figure = re.fullmatch(r"([a-z]\w*) +-?[\d.]+(?:e-\d+)?", line)
            if figure:
                assert figure[1] in names, f"{command}: {line}"
                num_figures += 1
    assert num_figures > 15


def test_the_first_page_shows_what_info_prints(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(ROOT)
    command, lines = commands_on(EXAMPLE)[0], shown_after(EXAMPLE)[0]
    assert main(shlex.split(command)) == 0
    printed = capsys.readouterr().out.splitlines()
    assert (len(lines), [line for line in lines if line not in printed]) == (5, [])


FORMATS = ROOT / "docs" / "formats.md"


def test_every_proof_of_the_page_is_a_test() -> None:
    proofs = re.findall(r"`(\S+\.py): (\w+)`", FORMATS.read_text(encoding="utf-8"))
    assert len(proofs) > 40
    missing = [
        f"{file}: {name}"
        for file, name in proofs
        if f"def {name}(" not in (ROOT / "tests" / file).read_text(encoding="utf-8")
    ]
    assert not missing
