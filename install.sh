#!/usr/bin/env bash
# Installs sattools with PyTorch's CPU build into the Python environment that is active; the Dockerfile runs it too.
#     install.sh [EXTRAS]          such as products,batch,notebook (the default)
set -euo pipefail
cd "$(dirname "$0")"
extras=${1:-products,batch,notebook}
# first, or pip would take the build with CUDA
python3 -m pip install --no-cache-dir --no-compile torch==2.13.0 --index-url "${TORCH_INDEX:-https://download.pytorch.org/whl/cpu}"
python3 -m pip install --no-cache-dir --no-compile --only-binary :all: setuptools
python3 -m pip install --no-cache-dir --no-compile ".[$extras]"
# kernels and bytecode are compiled here, whatever the environment says, and not with every first command
PYTHONDONTWRITEBYTECODE= sattools doctor --try
