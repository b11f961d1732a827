//! Samples that no longer can be computed with in SI units are refused, with the channel's name.

use crate::common::OSCILLATOR;
use greybox_calibrate::{Data, DataError};
use greybox_model::Model;
use greybox_recording::{Channel, Recording};

fn recording(f: f64, x: f64) -> Recording {
    let channel = |name: &str, unit: &str, second| {
        let values = (0..8).map(|k| if k == 1 { second } else { f64::from(k) }).collect();
        Channel { name: name.into(), unit: Some(unit.into()), values }
    };
    let time = (0..8).map(|k| f64::from(k) * 0.1).collect();
    Recording::from_columns("simulated", time, vec![channel("f", "kN", f), channel("x", "km", x)]).unwrap()
}

#[test]
fn samples_too_large_to_compute_with_are_refused() {
    let model = Model::from_toml(OSCILLATOR, "model.toml").unwrap();
    for (f, x, wrong, si) in [(1.0, -1e99, "x", 1e102), (1e98, 1.0, "f", 1e101)] {
        match Data::new(&model, &[recording(f, x)]) {
            Err(DataError::OutOfRange { channel, largest, .. }) => {
                assert_eq!(channel, wrong);
                assert!((largest / si - 1.0).abs() < 1e-12, "{largest:e}");
            }
            other => panic!("{wrong}: {:?}", other.map(|_| ())),
        }
    }
    assert!(Data::new(&model, &[recording(1e96, f64::NAN)]).is_ok());
}
