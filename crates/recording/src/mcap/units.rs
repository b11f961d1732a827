//! Units that the type of a message fixes.
//!
//! REP 103 (Standard Units of Measure and Coordinate Conventions) makes messages of ROS SI; the definitions in
//! `common_interfaces` say which quantity a field is. What a definition leaves open has no unit: positions and efforts of
//! a `JointState` are those of joints that turn or of joints that slide, a `Vector3` alone may be anything.

/// Message, field and the unit of every number in it.
const UNITS: [(&str, &str, &str); 28] = [
    ("geometry_msgs/Accel", "angular", "rad/s^2"),
    ("geometry_msgs/Accel", "linear", "m/s^2"),
    ("geometry_msgs/Inertia", "com", "m"),
    ("geometry_msgs/Inertia", "ixx", "kg m^2"),
    ("geometry_msgs/Inertia", "ixy", "kg m^2"),
    ("geometry_msgs/Inertia", "ixz", "kg m^2"),
    ("geometry_msgs/Inertia", "iyy", "kg m^2"),
    ("geometry_msgs/Inertia", "iyz", "kg m^2"),
    ("geometry_msgs/Inertia", "izz", "kg m^2"),
    ("geometry_msgs/Inertia", "m", "kg"),
    ("geometry_msgs/Pose", "position", "m"),
    ("geometry_msgs/Pose2D", "theta", "rad"),
    ("geometry_msgs/Pose2D", "x", "m"),
    ("geometry_msgs/Pose2D", "y", "m"),
    ("geometry_msgs/Transform", "translation", "m"),
    ("geometry_msgs/Twist", "angular", "rad/s"),
    ("geometry_msgs/Twist", "linear", "m/s"),
    ("geometry_msgs/Wrench", "force", "N"),
    ("geometry_msgs/Wrench", "torque", "N m"),
    ("sensor_msgs/BatteryState", "current", "A"),
    ("sensor_msgs/BatteryState", "temperature", "degC"),
    ("sensor_msgs/BatteryState", "voltage", "V"),
    ("sensor_msgs/FluidPressure", "fluid_pressure", "Pa"),
    ("sensor_msgs/Imu", "angular_velocity", "rad/s"),
    ("sensor_msgs/Imu", "linear_acceleration", "m/s^2"),
    ("sensor_msgs/MagneticField", "magnetic_field", "T"),
    ("sensor_msgs/Range", "range", "m"),
    ("sensor_msgs/Temperature", "temperature", "degC"),
];

/// The unit of what stands in the field of a message; `None` where its type does not say.
pub(super) fn of(message: &str, field: &str) -> Option<&'static str> {
    UNITS.iter().find(|(m, f, _)| *m == message && *f == field).map(|(.., unit)| *unit)
}
