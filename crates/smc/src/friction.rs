//! A sign that a sampled law can use.

/// tanh(v/ε): the sign of a velocity, smoothed over about ±2ε (`width` is ε, in units of `velocity`).
///
/// A law that takes Coulomb friction out of the plant must not use the true sign, for three reasons. At rest the
/// sign of a measured velocity is that of its noise, and the command would jump by twice the friction from sample to
/// sample. The true sign is not defined at zero, where friction takes whatever value holds the body; its tanh is
/// zero there, so that an equilibrium stays one. And the tangent of the law exists: 1/ε times the friction is a
/// damping that the law cancels and that the checks see.
///
/// ε should be above the noise of the velocity and well below the velocities of the motion; for the flexible link
/// of the thesis 0.01 to 0.05 rad/s. A smaller ε calls for faster sampling: f/(J ε) is the rate at which the law
/// feeds velocity back, where f/J is the deceleration by friction.
///
/// ε must be positive; zero gives the plain sign, which at rest is NaN.
///
/// ```
/// use greybox_smc::smooth_sign;
/// assert_eq!(smooth_sign(0.0, 0.05), 0.0);
/// assert!((smooth_sign(0.2, 0.05) - 1.0).abs() < 1e-3 && smooth_sign(-0.2, 0.05) < -0.999);
/// ```
#[must_use]
pub fn smooth_sign(velocity: f64, width: f64) -> f64 {
    libm::tanh(velocity / width)
}
