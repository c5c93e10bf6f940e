"""Room for images in the memory that processes share.

The sender's segment holds what its receivers have not yet fetched.  By default it is smaller than
a thermal image: half of the images are lost on the way, and come tens of milliseconds late where
both ends are reliable, once the receiver has missed them and asked again.
"""

from __future__ import annotations

import os
from collections.abc import MutableMapping
from pathlib import Path

PROFILE = Path(__file__).with_name("fastdds.xml")
VARIABLE = "FASTRTPS_DEFAULT_PROFILES_FILE"
SETTINGS_OF_OTHERS = (VARIABLE, "FASTDDS_DEFAULT_PROFILES_FILE", "FASTDDS_BUILTIN_TRANSPORTS")


def make_room_for_images(environment: MutableMapping[str, str] = os.environ) -> None:
    """Let Fast DDS read ``fastdds.xml``, unless the environment already tells it what to do.

    To be called before ``rclpy.init``; other middlewares do not look at the variable.
    """
    if not any(environment.get(name) for name in SETTINGS_OF_OTHERS):
        environment[VARIABLE] = str(PROFILE)
