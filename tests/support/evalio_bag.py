"""A recording as a data set of evalio's, for its command line: `evalio -M evalio_bag run ...`."""

import os
from enum import auto
from pathlib import Path

import numpy as np
from evalio._cpp.helpers import DataType, Field, PointCloudMetadata, pc2_to_evalio
from evalio.datasets import Dataset
from evalio.datasets.loaders import RawDataIter
from evalio.types import SE3, ImuParams, LidarParams, Stamp
from rosbags.highlevel import AnyReader


class Bag(Dataset):
    """The clouds of the bag that the environment names."""

    drive = auto()

    def data_iter(self):
        return RawDataIter(clouds(*self.files(), os.environ["POINTS"]), iter(()), len(self))

    def files(self):
        return [Path(os.environ["BAG"])]

    def quick_len(self):
        with AnyReader(self.files()) as reader:
            return sum(c.msgcount for c in reader.connections if c.topic == os.environ["POINTS"])

    def imu_T_lidar(self):  # noqa: N802
        return SE3.identity()

    def imu_T_gt(self):  # noqa: N802
        return SE3.identity()

    def imu_params(self):
        return ImuParams(gravity=np.array([0.0, 0.0, -9.8]))

    def lidar_params(self):
        return LidarParams(num_rows=1, num_columns=10_000, min_range=0.5, max_range=100.0)


def clouds(path, topic):
    with AnyReader([path]) as reader:
        connections = [c for c in reader.connections if c.topic == topic]
        for connection, _, data in reader.messages(connections):
            message = reader.deserialize(data, connection.msgtype)
            layout = PointCloudMetadata(
                stamp=Stamp(sec=message.header.stamp.sec, nsec=message.header.stamp.nanosec),
                width=message.width,
                height=message.height,
                point_step=message.point_step,
                row_step=message.row_step,
                is_bigendian=0,
                is_dense=1,
            )
            fields = [
                Field(name=f.name, datatype=DataType(f.datatype), offset=f.offset)
                for f in message.fields
            ]
            yield pc2_to_evalio(layout, fields, bytes(message.data))
