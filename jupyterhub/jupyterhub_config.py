"""A JupyterHub for a workshop: each participant a container of the Dockerfile's image, with the dashboard in it.

On one machine with Docker, for twenty people with two cores and 4 GB each as they work at once::

    docker build -t sightline-toolkit .
    docker network create workshop
    pip install 'jupyterhub>=5.3,<6' dockerspawner && npm install --global configurable-http-proxy
    WORKSHOP_PASSWORD=choose-a-long-one jupyterhub --config jupyterhub/jupyterhub_config.py

Everybody logs in with a name of their own and the one password: for a room on a closed network, and no more. For a
hub that can be reached from the internet take one of JupyterHub's other authenticators, and HTTPS.
"""

import os

c = get_config()  # noqa: F821

c.JupyterHub.spawner_class = "dockerspawner.DockerSpawner"
c.DockerSpawner.image = os.environ.get("WORKSHOP_IMAGE", "sightline-toolkit")
c.DockerSpawner.network_name = "workshop"
c.DockerSpawner.remove = True
c.DockerSpawner.volumes = {"workshop-{username}": "/home/jovyan/runs"}
c.DockerSpawner.notebook_dir = "/home/jovyan"
# Containers reach the hub by the address of its machine in Docker's network.
c.JupyterHub.hub_ip = "0.0.0.0"
c.JupyterHub.hub_connect_ip = os.environ.get("WORKSHOP_HUB", "host.docker.internal")
c.DockerSpawner.extra_host_config = {"extra_hosts": {"host.docker.internal": "host-gateway"}}

c.Spawner.cmd = ["jupyterhub-singleuser"]
c.Spawner.default_url = "/lab/tree/notebooks/00_tour.ipynb"
# The container is told its limits as CPU_LIMIT and MEM_LIMIT; binder/start sets the threads by the first.
c.Spawner.cpu_limit = 2
c.Spawner.mem_limit = "4G"
c.Spawner.start_timeout = 120

c.JupyterHub.authenticator_class = "shared-password"
c.SharedPasswordAuthenticator.user_password = os.environ["WORKSHOP_PASSWORD"]
c.Authenticator.allow_all = True
