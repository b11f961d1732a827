//! A pole of a loop, and how it is written.

use core::fmt;

/// A pole, in 1/s, or in z where it is said so.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Pole {
    /// Real part.
    pub re: f64,
    /// Imaginary part.
    pub im: f64,
}

impl Pole {
    /// Distance from zero.
    #[must_use]
    pub fn magnitude(&self) -> f64 {
        libm::hypot(self.re, self.im)
    }
}

/// `-8.22+28.1j`, to four digits; a real pole without the imaginary part.
impl fmt::Display for Pole {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        number(f, self.re)?;
        if self.im != 0.0 {
            number(f, self.im)?;
            f.write_str("j")?;
        }
        Ok(())
    }
}

/// Sign and four digits, with an exponent only where needed.
fn number(f: &mut fmt::Formatter<'_>, x: f64) -> fmt::Result {
    let size = x.abs();
    if size == 0.0 {
        return f.write_str("0");
    }
    if !(1e-3..1e6).contains(&size) {
        return write!(f, "{x:+.3e}");
    }
    let decimals = if size >= 1e3 { 0 } else { (3.0 - libm::floor(libm::log10(size))) as usize };
    write!(f, "{x:+.decimals$}")
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::string::ToString;

    #[test]
    fn poles_are_written_as_engineers_write_them() {
        let shown = [(1.25341, 0.0), (-23.3, 15.42), (-8.0, -0.123456), (0.0, 1e7), (-12345.6, 0.0)]
            .map(|(re, im)| Pole { re, im }.to_string());
        assert_eq!(shown, ["+1.253", "-23.30+15.42j", "-8.000-0.1235j", "0+1.000e7j", "-12346"]);
    }
}
