//! The messages that the node hears and says, field by field as ROS 2 sends them.

use ros2_client::{Message, builtin_interfaces::Time};
use serde::{Deserialize, Serialize};

#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Header {
    pub stamp: Time,
    pub frame_id: String,
}

#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct PointField {
    pub name: String,
    pub offset: u32,
    pub datatype: u8,
    pub count: u32,
}

#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct PointCloud2 {
    pub header: Header,
    pub height: u32,
    pub width: u32,
    pub fields: Vec<PointField>,
    pub is_bigendian: bool,
    pub point_step: u32,
    pub row_step: u32,
    pub data: Vec<u8>,
    pub is_dense: bool,
}
impl Message for PointCloud2 {}

#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct CustomPoint {
    pub offset_time: u32,
    pub position: [f32; 3],
    pub reflectivity: u8,
    pub tag: u8,
    pub line: u8,
}

/// The scan of a Livox, as its own driver sends it.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct CustomMsg {
    pub header: Header,
    pub timebase: u64,
    pub point_num: u32,
    pub lidar_id: u8,
    pub rsvd: [u8; 3],
    pub points: Vec<CustomPoint>,
}
impl Message for CustomMsg {}

#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Clock {
    pub clock: Time,
}
impl Message for Clock {}

/// Of a measurement of an IMU, the begin: the rest is not read.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Imu {
    pub header: Header,
}
impl Message for Imu {}

type Covariance = ([f64; 18], [f64; 18]);

#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Odometry {
    pub header: Header,
    pub child_frame_id: String,
    pub position: [f64; 3],
    pub orientation: [f64; 4],
    pub pose_covariance: Covariance,
    pub twist: [f64; 6],
    pub twist_covariance: Covariance,
}
impl Message for Odometry {}

#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct TransformStamped {
    pub header: Header,
    pub child_frame_id: String,
    pub translation: [f64; 3],
    pub rotation: [f64; 4],
}

#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Transforms(pub Vec<TransformStamped>);
impl Message for Transforms {}
