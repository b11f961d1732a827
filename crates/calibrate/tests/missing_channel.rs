//! A recording that lacks a channel: the error says how to give the model one of those that there are.

use greybox_calibrate::Data;
use greybox_model::Model;
use greybox_recording::parse_csv;

const MODEL: &str = r#"
[inputs]
u = { unit = "V" }
[states]
theta = { unit = "rad", channel = "angel" }
[parameters]
N = { value = 20, unit = "1" }
w = { value = 1, unit = "1/s" }
g = { value = 1, unit = "1/(V s^2)" }
[equations]
shaft = "theta'' + w^2*theta = g*u"
[measurements]
spead = { expression = "N*theta'", unit = "rpm" }
"#;

fn refusal(header: &str) -> String {
    let rows: String = (0..20).map(|k| format!("0.{k:02},{k},{k},{k}\n")).collect();
    let csv = format!("{header}\n{rows}");
    let recording = parse_csv(csv.as_bytes(), "run.csv").unwrap();
    let model = Model::from_toml(MODEL, "m.toml").unwrap();
    Data::new(&model, &[recording]).unwrap_err().to_string()
}

#[test]
fn a_slip_in_the_name_of_a_state_s_channel_is_corrected_at_the_state() {
    let reported = refusal("t,u,angle,spead");
    assert!(reported.contains("Did you mean `angle`?"), "{reported}");
    assert!(
        reported.contains("`--map angel=angle`, or in the model, `theta = { channel = \"angle\" }`"),
        "{reported}"
    );
}

#[test]
fn a_measurement_is_corrected_at_its_key() {
    let reported = refusal("t,u,angel,speed");
    assert!(reported.contains("`speed` in the place of `spead` under `[measurements]`"), "{reported}");
}

#[test]
fn where_no_name_is_near_none_is_guessed() {
    let reported = refusal("t,f,angel,spead");
    assert!(!reported.contains("Did you mean"), "{reported}");
    assert!(reported.contains("`--map u=…`, or in the model, `u = { channel = \"…\" }`"), "{reported}");
}
