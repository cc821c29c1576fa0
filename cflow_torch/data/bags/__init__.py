"""Reader of ROS 1, ROS 2 and MCAP bags, without ROS (experimental)."""

from cflow_torch.data.bags.reader import BagLog, find_bags

__all__ = ["BagLog", "find_bags"]
