"""Open3D's multiway registration of stationary cameras from recorded poses, for comparison with `calibrate`."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from splatctrl_cli.geometry import back_project, invert_transform
from splatctrl_cli.records import Float64, RgbdFrame

STEPS = (0.02, 0.005)  # [m] between points, of a first and a last look
REACHES = (
    (0, 0.15),
    (0, 0.08),
    (0, 0.04),
    (1, 0.02),
    (1, 0.01),
)  # which look, and [m] between points that are paired
DEPTHS = (0.05, 3.0)  # [m]


def multiway(frames: Sequence[RgbdFrame]) -> list[Float64]:
    """T_world_camera (4, 4) of each frame, the first as recorded: point-to-plane ICP of every pair, then a pose
    graph.
    """
    import open3d

    reg = open3d.pipelines.registration
    clouds = [[_cloud(open3d, frame, step) for frame in frames] for step in STEPS]
    recorded = [frame.T_world_camera for frame in frames]
    graph = reg.PoseGraph()
    graph.nodes.extend(reg.PoseGraphNode(T) for T in recorded)
    for j in range(len(frames)):
        for i in range(j):
            T = invert_transform(recorded[j]) @ recorded[i]
            for look, reach in REACHES:
                plane = reg.TransformationEstimationPointToPlane(reg.TukeyLoss(k=reach / 2))
                until = reg.ICPConvergenceCriteria(1e-9, 1e-9, 100)
                T = reg.registration_icp(clouds[look][i], clouds[look][j], reach, T, plane, until).transformation
            fit = reg.get_information_matrix_from_point_clouds(clouds[1][i], clouds[1][j], REACHES[-1][1], T)
            graph.edges.append(reg.PoseGraphEdge(i, j, T, fit, uncertain=j != i + 1))
    reg.global_optimization(
        graph,
        reg.GlobalOptimizationLevenbergMarquardt(),
        reg.GlobalOptimizationConvergenceCriteria(),
        reg.GlobalOptimizationOption(
            max_correspondence_distance=REACHES[-1][1], edge_prune_threshold=0.25, reference_node=0
        ),
    )
    found = [np.asarray(node.pose) for node in graph.nodes]
    return [recorded[0] @ invert_transform(found[0]) @ T for T in found]


def _cloud(open3d: Any, frame: RgbdFrame, step: float) -> Any:
    points = back_project(frame.intrinsics, frame.depth).reshape(-1, 3)
    points = points[(points[:, 2] > DEPTHS[0]) & (points[:, 2] < DEPTHS[1])]
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points)).voxel_down_sample(step)
    cloud.estimate_normals(open3d.geometry.KDTreeSearchParamHybrid(radius=4 * step, max_nn=30))
    cloud.orient_normals_towards_camera_location(np.zeros(3))
    return cloud
