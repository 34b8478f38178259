"""Numbers of controller, planner and verdict: III-E and IV."""

from dataclasses import dataclass
from typing import Annotated

from splatctrl_cli.config.declared import OneOf, Section, Within, check


@dataclass(frozen=True, kw_only=True)
class ControlConfig(Section, section="control"):
    """III-E: QP inverse kinematics with control barrier functions."""

    preset: Annotated[
        str, OneOf(("reduced", "paper"), "III-E as printed has barrier_gain = 1 and no second look")
    ] = "reduced"
    solver: Annotated[
        str, OneOf(("clarabel", "daqp"), "of the QP; daqp: an active-set method, several times as fast")
    ] = "clarabel"
    margin: Annotated[float, Within(0, 1, "m", "epsilon, IV-C; an arm reaches a metre")] = 0.02
    human_margin: Annotated[float, Within(0, 2, "m", "the same to people (label human), where it is larger")] = 0.0
    coverage: Annotated[
        str, OneOf(("report", "margin"), "of the spheres: say what they leave uncovered, or keep that much more, too")
    ] = "report"
    period: Annotated[
        float, Within(1e-4, 0.1, "s", "dt; the paper solves at more than 100 Hz; robots take 10 Hz to 10 kHz")
    ] = 0.01
    barrier_gain: Annotated[
        float,
        Within(1e-3, 10_000, "1/s", "alpha of every limit and barrier row; 1 (as printed) takes 1.4 times as long"),
    ] = 10.0
    self_margin: Annotated[
        float, Within(0, 0.5, "m", "epsilon of the self-collision rows, III-E; links are no further apart")
    ] = 0.02
    weight_linear: Annotated[float, Within(1e-9, 1e9, "", "Q of III-E, linear part; III-E gives no weights")] = 10.0
    weight_angular: Annotated[float, Within(1e-9, 1e9, "", "Q of III-E, angular part")] = 1.0
    weight_kinematics: Annotated[
        float, Within(1e-6, 1e9, "", "R of III-E as a multiple of Q: (1/Q + 1/R)^-1 is then 0.99 Q")
    ] = 100.0
    weight_slack: Annotated[float, Within(1e-6, 1e9, "", "S of III-E")] = 100.0
    slack_cost: Annotated[
        float,
        Within(1e-3, 1e9, "1/(m/s)", "L1 cost of an external slack: above every multiplier met, so exact"),
    ] = 1e3
    self_slack_cost: Annotated[
        float, Within(1e-3, 1e9, "1/(m/s)", "the same for self-collision rows: given up last")
    ] = 1e5
    posture_weight: Annotated[
        float,
        Within(1e-9, 1e3, "", "lambda on joint velocity; without it 7 joints on a 6-D task are undetermined"),
    ] = 1e-3
    smoothness_weight: Annotated[
        float, Within(0, 1e3, "", "weight on the change of joint velocity since the last step; see replay.md")
    ] = 0.0
    posture_gain: Annotated[float, Within(0, 1000, "1/s", "pull towards the home posture, under posture_weight")] = (
        0.5
    )
    pose_gain: Annotated[float, Within(0, 1000, "1/s", "pose error to end-effector velocity")] = 2.0
    max_linear_speed: Annotated[
        float,
        Within(1e-4, 20, "m/s", "cap of the reference: a usual speed beside people; the fastest arms reach 10"),
    ] = 0.25
    max_angular_speed: Annotated[float, Within(1e-4, 50, "rad/s", "the same of its rotation")] = 1.0
    twist_timeout: Annotated[
        float, Within(1e-3, 60, "s", "a logged twist holds; then the arm is asked to stand still")
    ] = 0.5
    max_acceleration: Annotated[
        float | tuple[float, ...],
        Within(0.01, 1000, "rad/s^2", "of every joint, or one for each; 0: no limit", or_zero=True),
    ] = 0.0
    velocity_limits: Annotated[
        str, OneOf(("urdf", "fr3"), "fr3: also those published for the Franka Research 3, by position")
    ] = "urdf"
    distance_rate: Annotated[
        str,
        OneOf(("snapshots", "none"), "dd/dt of the rows: what distances lost between the two newest scenes"),
    ] = "snapshots"
    max_distance_rate: Annotated[
        float, Within(0, 20, "m/s", "that a scene is taken to approach with at most: a walking person")
    ] = 1.6
    max_residual: Annotated[
        float, Within(1e-12, 1e-2, "", "a solution whose relative KKT residual exceeds this is not used")
    ] = 1e-5
    slack_tolerance: Annotated[float, Within(0, 0.1, "m/s", "slack above which a row counts as relaxed")] = 1e-4
    promise_tolerance: Annotated[
        float, Within(0, 0.1, "m", "a step may fall short of what its rows promised before it is scaled back")
    ] = 1e-4
    limit_tolerance: Annotated[
        float, Within(0, 0.1, "rad", "a start this far outside a joint limit is encoder noise")
    ] = 1e-3
    goal_position: Annotated[
        float, Within(1e-6, 0.1, "m", "the goal counts as reached; a decimetre off is another place")
    ] = 0.01
    goal_rotation: Annotated[float, Within(1e-6, 3.15, "rad", "1 degree; from 180 on any rotation will do")] = 0.0175
    max_time: Annotated[float, Within(1e-4, 86_400, "s", "of a closed-loop replay")] = 30.0
    stall_time: Annotated[float, Within(1e-4, 86_400, "s", "a local minimum: over this long ...")] = 2.0
    stall_speed: Annotated[float, Within(0, 10, "rad/s", "... the joints moved on average slower than this")] = 2e-3
    max_cuts: Annotated[
        int, Within(0, 1000, "", "rounds of further rows against what a solution would have met beside its rows")
    ] = 3
    max_detours: Annotated[
        int, Within(0, 1000, "", "planned ways out of a local minimum that a closed loop may take ([planner])")
    ] = 0
    stop_acceleration: Annotated[
        float,
        Within(
            0.01,
            1000,
            "rad/s^2",
            "a monitored standstill brakes and starts with, the Panda's; 0: at once",
            or_zero=True,
        ),
    ] = 7.5

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("barrier_gain", "pose_gain", "posture_gain"):  # a gain above 1 / dt overshoots
            gain = getattr(self, name)
            expected = f"at most 1 / control.period = {1 / self.period:g} 1/s"
            check(gain * self.period <= 1 + 1e-9, f"control.{name}", expected, gain)
        own, external = self.self_slack_cost, self.slack_cost
        check(own >= external, "control.self_slack_cost", f"at least control.slack_cost = {external:g} 1/(m/s)", own)
        for name in ("max_time", "stall_time"):
            check(
                getattr(self, name) >= self.period, f"control.{name}", "at least control.period", getattr(self, name)
            )


@dataclass(frozen=True, kw_only=True)
class PlannerConfig(Section, section="planner"):
    """IV: the sampling-based planner (BiRRT) that the controller is compared with."""

    seed: Annotated[int, Within(0, 2**31 - 1, "", "of samples and shortcuts; the same seed, the same path")] = 0
    goal_postures: Annotated[
        int, Within(1, 1000, "", "of a goal pose, sought from twice as many guesses; a path may end in any")
    ] = 8
    contact: Annotated[
        float,
        Within(
            1e-7, 0.1, "m", "clearance above the margin that a posture needs; bounds the checks of a grazing edge"
        ),
    ] = 1e-4
    batch: Annotated[int, Within(1, 10_000, "", "samples per iteration, whose edges are checked together")] = 8
    reach: Annotated[float, Within(1e-3, 100, "rad", "longest edge grown towards a sample, in joint space")] = 1.5
    shortest: Annotated[float, Within(1e-6, 10, "rad", "shortest edge that is worth a node")] = 0.1
    max_iterations: Annotated[int, Within(0, 10_000_000, "", "then a search ends as out-of-iterations")] = 4000
    max_time: Annotated[
        float, Within(0, 86_400, "s", "then as out-of-time: the only thing here that depends on the machine")
    ] = 10.0
    shortcut_rounds: Annotated[int, Within(0, 10_000, "", "of random shortcuts, after the greedy ones")] = 4
    shortcut_batch: Annotated[int, Within(1, 10_000, "", "shortcuts tried per round")] = 8
    max_acceleration: Annotated[float, Within(0.01, 1000, "rad/s^2", "of every joint: the least of the Panda's")] = (
        7.5
    )
    follow_gain: Annotated[
        float, Within(0, 10_000, "1/s", "joint error to joint velocity, where a path is followed in joint space")
    ] = 10.0
    wait_distance: Annotated[
        float, Within(1e-4, 10, "m", "the reference waits while the end effector is this far behind it")
    ] = 0.05
    limit_tolerance: Annotated[
        float, Within(0, 0.1, "rad", "a start or goal this far outside a joint limit is encoder noise")
    ] = 1e-3

    def __post_init__(self) -> None:
        super().__post_init__()
        low, high = self.shortest, self.reach
        check(low <= high, "planner.shortest", f"at most planner.reach = {high:g} rad", low)


@dataclass(frozen=True, kw_only=True)
class VerdictConfig(Section, section="verdict"):
    """What evidence a verdict asks for."""

    confidence: Annotated[
        float, Within(0.5, 0.999999, "", "of the bound on the map's error, where there are enough blocks for it")
    ] = 0.99
    evidence_reach: Annotated[
        float, Within(0.001, 10, "m", "from the moving spheres within which held-out surface is evidence of the map")
    ] = 0.1
    unjudged: Annotated[
        float, Within(0, 1, "", "share of the requested time that may go unjudged; more cannot be evaluated")
    ] = 0.0
    lead_in: Annotated[
        float, Within(0, 10, "s", "before the first map that is left out; logs have joints before images")
    ] = 0.5
    longest_interval: Annotated[
        float, Within(0.001, 10, "s", "between states over which the arm is taken to have moved straight")
    ] = 0.1
