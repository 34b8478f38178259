"""The public Python API (docs/api.md): jobs, requests, results and errors.

``import splatctrl_cli`` offers the same names, and loads this module on first use.
"""

from splatctrl_cli.config import Config, load_config
from splatctrl_cli.control.user_controller import ClearanceRow, Controller, ControllerInput, ControllerStart
from splatctrl_cli.errors import InputError, NotEvaluableError, SplatCtrlError, UsageError, WriteError
from splatctrl_cli.evaluate.verdict import JudgedResult, Outcome, Reason, Result, Verdict
from splatctrl_cli.jobs.audit import AuditRequest, audit
from splatctrl_cli.jobs.bake.bake import bake
from splatctrl_cli.jobs.bake.request import BakeRequest
from splatctrl_cli.jobs.compare.compare import CompareRequest, CompareResult, compare
from splatctrl_cli.jobs.export.export import (
    ExportRequest,
    ExportRunRequest,
    export,
    export_run,
)
from splatctrl_cli.jobs.query.query import QueryRequest, query
from splatctrl_cli.jobs.reconstruct.reconstruct import reconstruct
from splatctrl_cli.jobs.reconstruct.reconstruction import ReconstructRequest
from splatctrl_cli.jobs.recordings.open_recording import RecordingRequest, open_to_train
from splatctrl_cli.jobs.render import RenderSceneRequest, render_scene
from splatctrl_cli.jobs.replay.replay import ReplayResult, replay
from splatctrl_cli.jobs.replay.request import ReplayRequest
from splatctrl_cli.jobs.report.report import (
    ViewRequest,
    WriteReportRequest,
    view,
    write_report,
)
from splatctrl_cli.jobs.running.progress import Progress
from splatctrl_cli.jobs.score.score import ScoreRequest, score
from splatctrl_cli.recording.source_options import SourceOptions
from splatctrl_cli.records import Box, Label

__all__ = [
    "AuditRequest",
    "BakeRequest",
    "Box",
    "ClearanceRow",
    "CompareRequest",
    "CompareResult",
    "Config",
    "Controller",
    "ControllerInput",
    "ControllerStart",
    "ExportRequest",
    "ExportRunRequest",
    "InputError",
    "JudgedResult",
    "Label",
    "NotEvaluableError",
    "Outcome",
    "Progress",
    "QueryRequest",
    "Reason",
    "ReconstructRequest",
    "RecordingRequest",
    "RenderSceneRequest",
    "ReplayRequest",
    "ReplayResult",
    "Result",
    "ScoreRequest",
    "SourceOptions",
    "SplatCtrlError",
    "UsageError",
    "Verdict",
    "ViewRequest",
    "WriteError",
    "WriteReportRequest",
    "audit",
    "bake",
    "compare",
    "export",
    "export_run",
    "load_config",
    "open_to_train",
    "query",
    "reconstruct",
    "render_scene",
    "replay",
    "score",
    "view",
    "write_report",
]
