"""`python -m kinetix_dist`: the command `kinetix-dist`, where the package is not installed as one."""

import sys

from kinetix_dist.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
