"""Starts what install.py has installed: python start.py lab, dashboard or check"""

# Read by whatever Python a participant has, as install.py is.
import sys

if sys.version_info < (3, 11):  # noqa: UP036
    sys.exit("Python 3.11 or newer is needed, this is Python %d.%d." % sys.version_info[:2])  # noqa: UP031

from kit.starting import main

if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
