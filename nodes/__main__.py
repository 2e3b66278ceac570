"""``python -m nodes`` is ``relnav``."""

import sys

from nodes.cli import main

sys.exit(main())
