"""Pictures: bird's-eye view of a flow, in the field's colours. Needs `pip install 'cflow_torch[viz]'`."""

from cflow_torch.viz.animation import save_animation
from cflow_torch.viz.bev import plot_flow, save_picture
from cflow_torch.viz.wheel import flow_to_rgb, wheel_image

__all__ = ["flow_to_rgb", "plot_flow", "save_animation", "save_picture", "wheel_image"]
