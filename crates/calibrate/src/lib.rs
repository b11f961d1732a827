//! Parameter estimation by multiple shooting and output error, with covariance.
