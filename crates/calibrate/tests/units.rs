//! The units of headers: absolute temperatures, differences of them, and symbols that the model declares.

use greybox_calibrate::{Data, DataError};
use greybox_model::Model;
use greybox_recording::{Channel, Recording};

const HEATER: &str = r#"
[units]
enc = "0.001 rad"
dose = "own"
[inputs]
u = { unit = "dose/s" }
Ta = { unit = "K" }
[states]
T = { unit = "degC" }
phi = { unit = "rad" }
[parameters]
tau = { value = 5, unit = "s" }
k = { value = 2, unit = "K s/dose" }
[equations]
heat = "tau*T' + T = Ta + k*u"
turn = "tau*phi' + phi = 0"
[measurements]
rise = "T - Ta"
"#;

/// Channels called `name [unit]`, each 20, 21, … .
fn recording(headers: &[&str]) -> Recording {
    let channels = headers.iter().map(|header| {
        let (name, unit) = header.split_once(" [").map_or((*header, None), |(n, u)| (n, Some(u)));
        let unit = unit.map(|u| u.trim_end_matches(']').to_owned());
        Channel { name: name.into(), unit, values: (0..8).map(|k| 20.0 + f64::from(k)).collect() }
    });
    let time = (0..8).map(|k| f64::from(k) * 0.1).collect();
    Recording::from_columns("run.csv", time, channels.collect()).unwrap()
}

#[test]
fn headers_are_read_on_their_scale() {
    let model = Model::from_toml(HEATER, "heater.toml").unwrap();
    for (header, first) in [
        ("u", 20.0),
        ("u [dose/min]", 20.0 / 60.0),
        ("Ta", 20.0),
        ("Ta [degC]", 293.15),
        ("Ta [\u{b0}F]", (20.0 + 459.67) / 1.8),
        ("T", 293.15),
        ("T [K]", 20.0),
        ("T [mK]", 0.02),
        ("phi [enc]", 0.02),
        ("rise", 20.0),
        // A difference has no zero.
        ("rise [degC]", 20.0),
        ("rise [degF]", 20.0 / 1.8),
    ] {
        let name = header.split(' ').next().unwrap();
        let others = ["u", "Ta", "T", "phi", "rise"].into_iter().filter(|n| *n != name);
        let headers: Vec<&str> = others.chain([header]).collect();
        let data = Data::new(&model, &[recording(&headers)]).unwrap();
        let piece = &data.pieces[0];
        let input = model.input(name).map(|i| &piece.inputs[i]);
        let channel = data.channels.iter().position(|c| c.name == name).map(|c| &piece.measured[c]);
        let value = input.or(channel).unwrap()[0];
        assert!((value - first).abs() < 1e-12, "{header}: {value}");
    }
    let data = Data::new(&model, &[recording(&["u", "Ta", "T", "phi", "rise"])]).unwrap();
    let back = |name: &str| data.channels.iter().find(|c| c.name == name).unwrap().unit.from_si(293.15);
    assert!((back("T") - 20.0).abs() < 1e-12 && back("rise") == 293.15);
}

#[test]
fn a_header_that_does_not_fit_is_an_error() {
    let model = Model::from_toml(HEATER, "heater.toml").unwrap();
    for (headers, wrong, says) in [
        (["u [lot/s]", "Ta", "T", "phi", "rise"], "u", "unknown unit `lot`"),
        (["u [1/s]", "Ta", "T", "phi", "rise"], "u", "`dose/s`"),
        (["u", "Ta [degC/s]", "T", "phi", "rise"], "Ta", "`K`"),
        (["u", "Ta", "T [dose]", "phi", "rise"], "T", "`degC`"),
        (["u", "Ta", "T [Celsius]", "phi", "rise"], "T", "write `degC`"),
    ] {
        let error = Data::new(&model, &[recording(&headers)]).unwrap_err();
        let (DataError::Unit { channel, .. } | DataError::UnreadableUnit { channel, .. }) = &error else {
            panic!("{error}");
        };
        assert_eq!(channel, wrong);
        assert!(error.to_string().contains(says), "{error}");
    }
}
