//! Properties of units: products, powers, prefixes, and what is written is read again.

use greybox_model::{Dimension, Model, Unit};
use proptest::prelude::*;

/// Symbol, factor, exponents of m, kg, s and A: another table than the crate's.
const SYMBOLS: [(&str, f64, [i32; 4]); 9] = [
    ("m", 1.0, [1, 0, 0, 0]),
    ("g", 1e-3, [0, 1, 0, 0]),
    ("s", 1.0, [0, 0, 1, 0]),
    ("A", 1.0, [0, 0, 0, 1]),
    ("N", 1.0, [1, 1, -2, 0]),
    ("V", 1.0, [2, 1, -3, -1]),
    ("Pa", 1.0, [-1, 1, -2, 0]),
    ("H", 1.0, [2, 1, -2, -2]),
    ("rad", 1.0, [0, 0, 0, 0]),
];

const PREFIXES: [(&str, f64); 5] = [("", 1.0), ("m", 1e-3), ("k", 1e3), ("u", 1e-6), ("M", 1e6)];

/// A factor of a unit: text, factor to SI, exponents.
fn factor() -> impl Strategy<Value = (String, f64, [i32; 4])> {
    let symbol = prop::sample::select(SYMBOLS.to_vec());
    (prop::sample::select(PREFIXES.to_vec()), symbol, -3..4i32).prop_map(
        |((prefix, scale), (symbol, si, exponents), power)| {
            let power_text = if power == 1 { String::new() } else { format!("^{power}") };
            let text = format!("{prefix}{symbol}{power_text}");
            (text, (scale * si).powi(power), exponents.map(|e| e * power))
        },
    )
}

proptest! {
    #[test]
    fn a_unit_is_the_product_of_its_factors(
        factors in prop::collection::vec((factor(), 0..3usize), 1..5),
    ) {
        let (mut text, mut si, mut exponents) = (String::new(), 1.0, [0; 4]);
        for (k, ((part, scale, powers), sign)) in factors.iter().enumerate() {
            let divides = k > 0 && *sign == 2;
            text += if k == 0 { "" } else { [" ", "*", "/"][*sign] };
            text += part;
            si *= if divides { 1.0 / scale } else { *scale };
            for (e, p) in exponents.iter_mut().zip(powers) {
                *e += if divides { -p } else { *p };
            }
        }
        let unit = Unit::parse(&text).map_err(|e| TestCaseError::fail(format!("{text}: {e}")))?;
        let mut wanted = [0.0; 7];
        for (w, e) in wanted.iter_mut().zip(exponents) {
            *w = f64::from(e);
        }
        prop_assert!(unit.dimension.same(&Dimension::from_si(wanted)), "{}: {:?} {:?}", text, unit, wanted);
        prop_assert!((unit.factor / si - 1.0).abs() < 1e-12, "{}: {} {}", text, unit.factor, si);
        // Written in SI it is of the same dimension.
        let written = Unit::si(unit.dimension);
        let again = Unit::parse(&written.text).map_err(|e| TestCaseError::fail(format!("{written}: {e}")))?;
        prop_assert!(again.dimension.same(&unit.dimension) && again.factor == 1.0, "{text} = {written}");
    }

    #[test]
    fn a_value_is_the_same_in_any_unit(value in 1e-3..1e3f64, prefix in prop::sample::select(PREFIXES.to_vec())) {
        let (prefix, scale) = prefix;
        let text = format!(
            "[inputs]\nu = {{ unit = \"N\" }}\n[states]\ny = {{ unit = \"{prefix}m\", initial = {} }}\n[parameters]\n\
             k = {{ value = {}, unit = \"N/{prefix}m\" }}\nm = {{ value = 2, unit = \"kg\" }}\n\
             [equations]\ne = \"m*y'' + k*y = u\"\n",
            value / scale, value * scale,
        );
        let model = Model::from_toml(&text, "any.toml").unwrap();
        prop_assert!((model.parameters[0].value / value - 1.0).abs() < 1e-12);
        prop_assert!((model.states[0].initial[0] / value - 1.0).abs() < 1e-12);
        // An acceleration in the place of a position is found out, whatever the prefix.
        prop_assert!(Model::from_toml(&text.replace("k*y =", "k*y'' ="), "any.toml").is_err());
    }
}
