"""JupyterLab with the dashboard behind it: one address, one log-in.

The dashboard is started when somebody opens it, listens on the machine's own loopback alone, and is reached through
Jupyter's address ending in ``/dashboard/`` (package jupyter-server-proxy). Who may open it is Jupyter's to say.
"""

import os
import sys

c = get_config()  # noqa: F821

c.ServerProxy.servers = {
    "dashboard": {
        "command": [
            sys.executable,
            "-m",
            "toolkit",
            "dashboard",
            "--port",
            "{port}",
            "--runs",
            os.environ.get("TOOLKIT_RUNS", "runs"),
            # The address by which browsers come is Jupyter's, which is not known here; without Jupyter's log-in
            # nobody gets as far as this.
            "--origin",
            "*",
        ],
        # The first start compiles nothing, but loads Panel.
        "timeout": 120,
        "launcher_entry": {"title": "Dashboard"},
    }
}
# Open3D brings dash, which would have JupyterLab built anew; nothing here needs that.
c.ServerApp.tornado_settings = {"page_config_data": {"buildCheck": False, "buildAvailable": False}}
