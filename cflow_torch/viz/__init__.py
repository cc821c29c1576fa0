"""Pictures of a flow and of every stage on the way to it (needs matplotlib), and 3-D pages (needs k3d)."""

from cflow_torch.viz.animation import AnimatedPair, flow_figures, save_animation
from cflow_torch.viz.bev import plot_flow, plot_map, save_picture
from cflow_torch.viz.clusters import plot_clusters
from cflow_torch.viz.page import Page, save_page, show
from cflow_torch.viz.recording import record_log
from cflow_torch.viz.stage_pictures import plot_correlation, plot_keypoints, plot_scales
from cflow_torch.viz.wheel import flow_to_rgb, wheel_image

__all__ = [
    "AnimatedPair",
    "Page",
    "flow_figures",
    "flow_to_rgb",
    "plot_clusters",
    "plot_correlation",
    "plot_flow",
    "plot_keypoints",
    "plot_map",
    "plot_scales",
    "record_log",
    "save_animation",
    "save_page",
    "save_picture",
    "show",
    "wheel_image",
]
