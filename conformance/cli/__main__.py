"""`python -m ecatspec.conformance.cli`: the command line."""

import sys

from ecatspec.conformance.cli import main

sys.exit(main())
