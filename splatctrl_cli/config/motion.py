"""Numbers of controller, planner and verdict: III-E and IV."""

from dataclasses import dataclass
from typing import Annotated

from splatctrl_cli.config.ranges import MAX_SEED, OneOf, Section, Within, check


@dataclass(frozen=True, kw_only=True)
class ControlConfig(Section, section="control"):
    """III-E: QP inverse kinematics with control barrier functions."""

    program: Annotated[
        str, OneOf(("reduced", "printed"), "reduced form, or that of III-E as printed, without a second look")
    ] = "reduced"
    solver: Annotated[str, OneOf(("clarabel", "daqp"), "of the QP; daqp is several times as fast")] = "clarabel"
    margin: Annotated[float, Within(0, 1, "m", "epsilon, the clearance to keep (IV-C)")] = 0.02
    human_margin: Annotated[float, Within(0, 2, "m", "clearance to keep from people, where it is larger")] = 0.0
    coverage: Annotated[
        str,
        OneOf(("report", "margin"), "what the spheres leave uncovered: report it, or keep that much more clearance"),
    ] = "report"
    period: Annotated[float, Within(1e-4, 0.1, "s", "dt of a step; the paper solves at more than 100 Hz")] = 0.01
    barrier_gain: Annotated[
        float,
        Within(1e-3, 10_000, "1/s", "alpha of every limit and barrier row; the printed 1 takes 1.4 times as long"),
    ] = 10.0
    self_margin: Annotated[float, Within(0, 0.5, "m", "clearance of the self-collision rows (III-E)")] = 0.02
    weight_linear: Annotated[float, Within(1e-9, 1e9, "", "Q of III-E, linear part; the paper gives no weights")] = (
        10.0
    )
    weight_angular: Annotated[float, Within(1e-9, 1e9, "", "Q of III-E, angular part")] = 1.0
    weight_kinematics: Annotated[float, Within(1e-6, 1e9, "", "R of III-E in Q: (1/Q + 1/R)^-1 is 0.99 Q")] = 100.0
    weight_slack: Annotated[float, Within(1e-6, 1e9, "", "S of III-E")] = 100.0
    slack_cost: Annotated[
        float,
        Within(1e-3, 1e9, "1/(m/s)", "linear cost of a slack; above every multiplier met, so the slack is exact"),
    ] = 1e3
    self_slack_cost: Annotated[
        float, Within(1e-3, 1e9, "1/(m/s)", "for self-collision rows, which give way last")
    ] = 1e5
    posture_weight: Annotated[float, Within(1e-9, 1e3, "", "lambda on joint velocity: 7 joints, 6-D task")] = 1e-3
    smoothness_weight: Annotated[float, Within(0, 1e3, "", "weight on the change of joint velocity per step")] = 0.0
    posture_gain: Annotated[float, Within(0, 1000, "1/s", "pull towards the home posture")] = 0.5
    pose_gain: Annotated[float, Within(0, 1000, "1/s", "pose error to end-effector velocity")] = 2.0
    max_linear_speed: Annotated[
        float, Within(1e-4, 20, "m/s", "cap of the end effector's speed, usual near people")
    ] = 0.25
    max_angular_speed: Annotated[float, Within(1e-4, 50, "rad/s", "cap of its rotation")] = 1.0
    twist_timeout: Annotated[float, Within(1e-3, 60, "s", "how long a logged twist holds; then stand still")] = 0.5
    max_acceleration: Annotated[
        float | tuple[float, ...],
        Within(0.01, 1000, "rad/s^2", "of every joint, or one number for each; 0: no limit", or_zero=True),
    ] = 0.0
    velocity_limits: Annotated[
        str, OneOf(("urdf", "fr3"), "fr3: also the published position-dependent limits of the Franka Research 3")
    ] = "urdf"
    distance_rate: Annotated[str, OneOf(("snapshots", "none"), "dd/dt, from the two newest scenes")] = "snapshots"
    max_distance_rate: Annotated[float, Within(0, 20, "m/s", "fastest approach that counts: a walking person")] = 1.6
    max_residual: Annotated[float, Within(1e-12, 1e-2, "", "largest relative KKT residual that is accepted")] = 1e-5
    slack_tolerance: Annotated[float, Within(0, 0.1, "m/s", "a row with more slack counts as relaxed")] = 1e-4
    promise_tolerance: Annotated[
        float, Within(0, 0.1, "m", "how much a step may miss what its rows promised before it is scaled back")
    ] = 1e-4
    limit_tolerance: Annotated[
        float, Within(0, 0.1, "rad", "start beyond a joint limit that counts as encoder noise")
    ] = 1e-3
    goal_position: Annotated[float, Within(1e-6, 0.1, "m", "the goal is reached within this distance")] = 0.01
    goal_rotation: Annotated[float, Within(1e-6, 3.15, "rad", "the goal is reached within this angle (1 degree)")] = (
        0.0175
    )
    max_time: Annotated[float, Within(1e-4, 86_400, "s", "longest closed-loop replay")] = 30.0
    stall_time: Annotated[float, Within(1e-4, 86_400, "s", "the joints hardly move for so long when stuck")] = 2.0
    stall_speed: Annotated[float, Within(0, 10, "rad/s", "mean joint speed of a stuck arm")] = 2e-3
    max_cuts: Annotated[int, Within(0, 1000, "", "rounds of further rows for what a step would come near")] = 3
    max_detours: Annotated[int, Within(0, 1000, "", "planned ways out of local minima in one closed loop")] = 0

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
    """IV: the sampling-based planner (BiRRT), which finds the controller's ways out of local minima."""

    seed: Annotated[int, Within(0, MAX_SEED, "", "of samples and shortcuts")] = 0
    goal_postures: Annotated[
        int, Within(1, 1000, "", "configurations sought for a goal pose; a path ends in any")
    ] = 8
    contact: Annotated[float, Within(1e-7, 0.1, "m", "clearance above the margin that a configuration needs")] = 1e-4
    batch: Annotated[int, Within(1, 10_000, "", "samples per iteration, whose edges are checked together")] = 8
    reach: Annotated[float, Within(1e-3, 100, "rad", "longest edge towards a sample, in joint space")] = 1.5
    shortest: Annotated[float, Within(1e-6, 10, "rad", "shortest edge worth a node")] = 0.1
    max_iterations: Annotated[int, Within(0, 10_000_000, "", "after which a search ends as out-of-iterations")] = 4000
    max_time: Annotated[
        float,
        Within(0, 86_400, "s", "after which it ends as out-of-time; the only limit that depends on the machine"),
    ] = 10.0
    shortcut_rounds: Annotated[int, Within(0, 10_000, "", "of random shortcuts, after the greedy ones")] = 4
    shortcut_batch: Annotated[int, Within(1, 10_000, "", "shortcuts tried per round")] = 8
    max_acceleration: Annotated[float, Within(0.01, 1000, "rad/s^2", "of every joint: the least of the Panda's")] = (
        7.5
    )
    wait_distance: Annotated[float, Within(1e-4, 10, "m", "the reference waits for an arm this far behind")] = 0.05
    limit_tolerance: Annotated[
        float, Within(0, 0.1, "rad", "a start or goal this far outside a joint limit is taken for encoder noise")
    ] = 1e-3

    def __post_init__(self) -> None:
        super().__post_init__()
        low, high = self.shortest, self.reach
        check(low <= high, "planner.shortest", f"at most planner.reach = {high:g} rad", low)


@dataclass(frozen=True, kw_only=True)
class VerdictConfig(Section, section="verdict"):
    """What evidence a verdict asks for."""

    confidence: Annotated[
        float, Within(0.5, 0.999999, "", "of the bound on the map's error, where there is enough evidence for it")
    ] = 0.99
    evidence_reach: Annotated[
        float, Within(0.001, 10, "m", "distance from the moving spheres within which held-out surface is evidence")
    ] = 0.1
    unjudged: Annotated[float, Within(0, 1, "", "share of the requested time that may go unjudged")] = 0.0
    lead_in: Annotated[
        float, Within(0, 10, "s", "time before the first map that may be left out, as logs have joints before images")
    ] = 0.5
    longest_interval: Annotated[
        float, Within(0.001, 10, "s", "longest gap between states over which the arm is taken to move straight")
    ] = 0.1
