"""A user's own controller in a replay: what the options say of it, and who commands the arm."""

import re
import shlex
from collections.abc import Iterator
from contextlib import contextmanager

from splatctrl_cli.config import ControlConfig
from splatctrl_cli.control.outside import STEP_LIMIT, OutsideController, class_command
from splatctrl_cli.control.step import OURS, Commander
from splatctrl_cli.errors import UsageError
from splatctrl_cli.jobs.progress import Progress
from splatctrl_cli.jobs.replays.request import ReplayRequest
from splatctrl_cli.jobs.replays.result import OutsideRun
from splatctrl_cli.records import Float64
from splatctrl_cli.robot.model import RobotModel


def check_controller(request: ReplayRequest) -> None:
    """Raise UsageError for a controller that no mode asks, that cannot be meant, or options without one."""
    if request.controller is None and request.controller_command is None:
        if request.controller_twice or request.controller_step_limit != STEP_LIMIT:
            raise UsageError(
                "--controller-twice, --controller-step-limit: expected a controller",
                remedy="give --controller or --controller-command, or leave them out",
            )
        return
    if request.controller is not None and request.controller_command is not None:
        raise UsageError("--controller, --controller-command: expected one of them, got both")
    if request.mode == "audit":
        raise UsageError(
            "--controller, --controller-command: expected --mode open-loop or closed-loop",
            remedy="an audit does not ask a controller",
        )
    _named_command(request)


@contextmanager
def commander_of(
    request: ReplayRequest,
    model: RobotModel,
    config: ControlConfig,
    console: Progress,
    *,
    frame: str,
    home: Float64 | None,
) -> Iterator[Commander]:
    """Who is asked: our own controller, or the user's, which has ended when this does. Raises InputError for one that
    does not start.
    """
    if request.controller is None and request.controller_command is None:
        yield OURS
        return
    name, command = _named_command(request)
    console.log(f"replay: starting the controller {name}")
    with OutsideController(
        name,
        command,
        model,
        config,
        frame=frame,
        home=home,
        step_limit=request.controller_step_limit,
        is_twice=request.controller_twice,
    ) as outside:
        yield outside
        if outside.num_answers:
            mean, slowest = outside.seconds / outside.num_answers, outside.slowest
            console.log(
                f"replay: {outside.num_answers} answers, {1e3 * mean:.2g} ms each, at most {1e3 * slowest:.2g}"
            )


def outside_run(commander: Commander) -> OutsideRun | None:
    """What there is to say of a user's controller, None of ours."""
    if not isinstance(commander, OutsideController):
        return None
    return OutsideRun(name=commander.name, num_answers=commander.num_answers, failure=commander.failure)


def _named_command(request: ReplayRequest) -> tuple[str, tuple[str, ...]]:
    """What people call the controller, and its command line."""
    if request.controller is not None:
        if not re.fullmatch(r"[^\W\d]\w*(\.[^\W\d]\w*)*:[^\W\d]\w*", request.controller):
            raise UsageError(f"--controller: expected module:Class, got {request.controller!r}")
        return request.controller, class_command(request.controller)
    text = request.controller_command or ""
    try:
        words = shlex.split(text)
    except ValueError as error:
        raise UsageError(f"--controller-command {text!r}: {error}", remedy="close the quotes") from None
    if not words:
        raise UsageError("--controller-command: expected a program and its arguments, got nothing")
    return text, tuple(words)
