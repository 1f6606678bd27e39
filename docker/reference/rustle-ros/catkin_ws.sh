# For login shells, of any user: what devel/setup.bash of a catkin workspace would set.
export ROS_DISTRO=debian
export ROS_PACKAGE_PATH=/catkin_ws/src:/usr/share
: "${ROS_MASTER_URI:=http://localhost:11311}"
export ROS_MASTER_URI
