"""JupyterLab as ``make lab`` starts it."""

# Open3D brings dash, which would have JupyterLab built anew; nothing here needs that.
c.ServerApp.tornado_settings = {"page_config_data": {"buildCheck": False, "buildAvailable": False}}  # noqa: F821
