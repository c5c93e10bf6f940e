"""Publishes two live thermal cameras as stereo pairs, and keeps them alive.

Both images of a pair carry one stamp.  While one camera is lost the other goes on alone, and the
lost one is opened again as soon as it is back.  Images are sent while somebody listens.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import replace

from thermal_stereo_vo.nodes import runtime
from thermal_stereo_vo.nodes.live_cameras import LiveCameras
from thermal_stereo_vo.outputs.ros_fields import WARN, DiagnosticFields
from thermal_stereo_vo.stereo_capture import EYES, StereoCaptureConfig


class StereoCaptureNode(runtime.BaseNode[StereoCaptureConfig]):
    """Live cameras to ``left|right/image_raw``."""

    NAME = "stereo_capture"
    CONFIG = StereoCaptureConfig
    TOPICS = """
        out  left/image_raw, right/image_raw      sensor_msgs/Image mono16 or mono8, common stamp
        out  left/camera_info, right/camera_info  sensor_msgs/CameraInfo, same stamp
        out  status                               diagnostic_msgs/DiagnosticArray of each pair:
                                                  sequence, skew, drops, correction, temperatures
        out  /diagnostics                         diagnostic_msgs/DiagnosticArray, once a second
        srv  ~/do_ffc                             std_srvs/Trigger: correct the flat field soon
        srv  ~/inhibit_ffc                        std_srvs/SetBool: no corrections for a while
        srv  ~/open_shutter                       std_srvs/Trigger: after a shock has closed it
        srv  ~/reconnect                          std_srvs/Trigger: close and open all cameras
        """

    def __init__(self) -> None:
        super().__init__()
        self._cameras = LiveCameras(self, self.config)
        self._cameras.start()

    def health(self) -> DiagnosticFields:
        fields = self._cameras.health()
        if len(self._cameras.infos) < len(EYES):
            hint = "not calibrated: set left_calibration and right_calibration"
            message = f"{fields.message}; {hint}"
            return replace(fields, level=max(fields.level, WARN), message=message)
        return fields

    def close(self) -> None:
        self._cameras.close()


def main(args: Sequence[str] | None = None) -> int:
    """Run the node."""
    return runtime.run(StereoCaptureNode, args)


if __name__ == "__main__":
    sys.exit(main())
