"""velodyne_msgs/VelodyneScan, the raw packets of a turn, to scans."""

import struct
from collections.abc import Callable

from adaptune.sequence.pointcloud2 import PointCloudError, from_fields
from adaptune.sequence.scan import Scan
from adaptune.sequence.serialized import Serialized
from adaptune.sequence.timing import Timing

TYPES = ("velodyne_msgs/msg/VelodyneScan",)
_PACKET = 1206


def decoder(cdr: bool) -> Callable[[bytes], Scan]:
    """Make a decoder for the messages of one LiDAR, serialised as in ROS 2 if `cdr`.

    The packets contain the LiDAR's model. A scan starts when its first packet was received,
    whatever the header's stamp marks. The decoder raises a PointCloudError for a message that is
    not whole, or of an unknown model. It needs the package velodyne_decoder.
    """
    import velodyne_decoder

    config = velodyne_decoder.Config()
    config.timestamp_first_packet = True
    turn = velodyne_decoder.ScanDecoder(config)

    def decode(data: bytes) -> Scan:
        try:
            body = Serialized(data, cdr)
            body.header()
            packets = []
            for _ in range(body.uint32()):
                stamp = body.uint32() * 10**9 + body.uint32()
                packets.append((stamp, bytes(body.block(_PACKET))))
            body.end()
        except (struct.error, ValueError, IndexError) as error:
            raise PointCloudError(f"not a whole VelodyneScan ({error})") from error
        if not packets:  # velodyne_decoder would crash
            raise PointCloudError("holds no packet")
        raw = [velodyne_decoder.VelodynePacket(at * 1e-9, packet) for at, packet in packets]
        try:
            _, points = turn.decode(velodyne_decoder.PacketVector(raw), True)
        except RuntimeError as error:
            raise PointCloudError(str(error)) from error
        return from_fields(points, packets[0][0], Timing("start"))

    return decode
