"""Installs the workshop beside this file, without any network: python install.py"""

# Read by whatever Python a participant has, Python 2 too, so that it can say that it is too old.
import sys

if sys.version_info < (3, 11):  # noqa: UP036
    sys.exit(
        "Python 3.11 or newer is needed, this is Python %d.%d.\n"  # noqa: UP031
        "Install one from the teacher's stick or from https://www.python.org/downloads/, and start this with it."
        % sys.version_info[:2]
    )

from kit.installing import main

if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
