//! Student's t.

use statrs::distribution::{ContinuousCDF, StudentsT};

/// The 97.5 % quantile of Student's t with `freedom` degrees of freedom, of fewer than one that of one. From 10⁶ on it
/// is the normal one, which differs by 2.4e-6; the search for the inverse of the distribution does not end where they
/// are 10⁸.
///
/// ```
/// use greybox_calibrate::student_quantile;
/// assert!((student_quantile(10.0) - 2.228_139).abs() < 1e-6);
/// assert!((student_quantile(1e8) - 1.959_964).abs() < 1e-6);
/// ```
pub fn student_quantile(freedom: f64) -> f64 {
    let normal = 1.959_963_984_540_054;
    if freedom >= 1e6 {
        return normal;
    }
    StudentsT::new(0.0, 1.0, freedom.max(1.0)).map_or(normal, |t| t.inverse_cdf(0.975))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_quantile_ends_for_any_number_of_samples() {
        assert!((student_quantile(10.0) - 2.228_138_852).abs() < 1e-8);
        for freedom in [1e6, 1e8, 1e12] {
            assert!((student_quantile(freedom) - 1.959_964).abs() < 3e-6, "{freedom}");
        }
    }
}
