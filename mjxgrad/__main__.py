"""`python -m mjxgrad`, which is `mjxgrad`."""

import sys

from mjxgrad.cli import main

sys.exit(main())
