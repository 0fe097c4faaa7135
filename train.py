"""Train, sweep and compare: `python train.py stage=gan overlap=50`. Everything it can do stands in conf/ and README.md."""

import sys

from overfly.run import main

if __name__ == "__main__":
    sys.exit(main())
