#!/bin/sh
# Open3D's wheel links against a few libraries of the system that a bare Debian lacks. Nothing happens where they
# are there. Otherwise they are installed where that is possible without asking, or the command is printed.
set -eu
python=$1
libraries="libusb-1.0.so.0 libGL.so.1 libEGL.so.1 libX11.so.6 libudev.so.1 libidn2.so.0 libgomp.so.1"
packages="libusb-1.0-0 libgl1 libegl1 libx11-6 libudev1 libidn2-0 libgomp1"

[ "$(uname -s)" = Linux ] || exit 0
missing=$("$python" - $libraries <<'PYTHON'
import ctypes
import sys

for name in sys.argv[1:]:
    try:
        ctypes.CDLL(name)
    except OSError:
        print(name, end=" ")
PYTHON
)
[ -n "$missing" ] || exit 0

install="apt-get install --yes --no-install-recommends $packages"
if [ "$(id -u)" = 0 ] && command -v apt-get >/dev/null; then
    echo "Installing Debian packages that Open3D needs (missing: $missing) ..."
    apt-get update -qq
    DEBIAN_FRONTEND=noninteractive $install -qq >/dev/null
else
    echo "Open3D needs libraries of the system that are missing here: $missing" >&2
    echo "On Debian and Ubuntu install them by: sudo $install" >&2
    exit 1
fi
