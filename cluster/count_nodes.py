"""Exit status 0 where the cluster in RAY_ADDRESS has as many nodes as the argument says, or more."""

import os
import sys

from ray._raylet import GcsClient  # what `ray health-check` asks; ray.init would need a node on this host

nodes = GcsClient(address=os.environ["RAY_ADDRESS"]).get_all_node_info(timeout=10)
sys.exit(sum(node.state == 0 for node in nodes.values()) < int(sys.argv[1]))  # 0: alive
