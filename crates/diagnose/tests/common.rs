//! What several of these tests use.

/// An oscillator, its parameters known roughly.
pub(crate) const OSCILLATOR: &str = r#"
name = "oscillator"
[inputs]
f = { unit = "N" }
[states]
x = { unit = "m" }
[parameters]
m = { value = 1.1, unit = "kg", std = 0.2 }
c = { value = 0.5, unit = "N s/m", std = 0.5 }
k = { value = 38.0, unit = "N/m", std = 8.0 }
[equations]
mass = "m*x'' + c*x' + k*x = f"
"#;
