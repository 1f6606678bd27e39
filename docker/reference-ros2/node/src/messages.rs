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
