"""``python3 -m thermal_stereo_vo VERB``."""

import sys

from thermal_stereo_vo.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
