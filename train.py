"""Train, sweep and evaluate: `python train.py stage=gan overlap=50`; conf/ and README.md say what else it can do."""

import sys

from overfly.run import main

if __name__ == "__main__":
    sys.exit(main())
