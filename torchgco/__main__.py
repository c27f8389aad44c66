"""python -m torchgco"""

import sys

from torchgco.experiments.app import main

sys.exit(main())
