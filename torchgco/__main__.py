"""python -m torchgco"""

import sys

from torchgco.experiments.app import main

if __name__ == "__main__":  # a worker process imports this file too
    sys.exit(main())
