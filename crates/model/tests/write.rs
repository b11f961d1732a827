//! Writing models back: what comes out reads like what went in.

use greybox_model::{Equation, Expr, Hold, Measurement, Model, Parameter, State, Unit, WriteOptions, parse};
use proptest::prelude::*;

const TEXT: &str = r#"# A drive.
name = "drive"   # the name

[inputs]
u = {unit="V"}          # odd spacing stays

[states]
# position
q = { unit = "mm", initial = 5 }  # by the encoder
i = { unit = "A", measured = false }

[parameters]
M  = { value = 95.0, unit = "kg", std = 10.0 }   # carriage
Fv = { unit = "N s/mm", value = 0.3, std = 0.15 }
kt = { value = 35.15065 }
L  = { value = 1e-2, unit = "s", fixed = true }

# the physics
[equations]
axis = "M*q''+Fv * q' = kt*i"    # Newton
coil = 'L*i' = u/R - i'
"#;

fn load(text: &str) -> Model {
    Model::from_toml(text, "test.toml").unwrap_or_else(|e| panic!("{e}\n{text}"))
}

fn drive() -> (String, Model) {
    // A literal string cannot hold a prime: write the coil in double quotes, and give it its R.
    let text = TEXT.replace("coil = 'L*i' = u/R - i'", "coil = \"L*i'=(u/R)-i\"");
    let text = text.replace("L  = {", "R  = { value = 2, unit = \"Ohm\" }\nL  = {");
    let model = load(&text);
    (text, model)
}

fn write(model: &Model, original: &str) -> String {
    model.to_toml(&WriteOptions { original: Some(original), ..Default::default() })
}

#[test]
fn an_unchanged_model_is_the_same_text() {
    let (text, model) = drive();
    assert_eq!(write(&model, &text), text);
    let windows = text.replace('\n', "\r\n");
    assert_eq!(write(&load(&windows), &windows), windows);
    // Without an end of the last line; found by the fuzzer.
    for open in [text.trim_end(), windows.trim_end()] {
        assert_eq!(write(&load(open), open), open);
    }
    // As the editors of Windows begin a file; found by the fuzzer.
    let marked = format!("\u{feff}{windows}");
    assert_eq!(write(&load(&marked), &marked), marked);
}

#[test]
fn only_what_changed_is_rewritten() {
    let (text, mut model) = drive();
    model.parameters[0].value = 96.123_456_789;
    model.parameters[1].value = 412.0; // N s/m, written in N s/mm
    model.parameters[1].std = None;
    model.inputs[0].hold = Hold::BandLimited;
    model.states[0].initial = vec![0.001, 0.002];
    model.name = "drive, improved".into();
    let fc = model.fresh_name("M");
    assert_eq!(fc, "M_2");
    let parameter = |name: &str, value| Parameter {
        name: name.into(),
        value,
        unit: None,
        std: None,
        fixed: false,
        positive: None,
    };
    model.parameters.push(parameter("fc", 20.123_456_7));
    model.add_term(0, parse("fc*sign(q')").unwrap().expr);
    model.measurements[0].expr = parse("q + so").unwrap().expr;
    model.parameters.push(Parameter { unit: Some(Unit::parse("mm").unwrap()), ..parameter("so", 0.0015) });
    model.resolve_units().unwrap();
    let comments = [("fc".to_owned(), "95 % interval\n[19, 21]".to_owned())];
    let written = model.to_toml(&WriteOptions { original: Some(&text), comments: &comments });
    let expected = text
        .replace("95.0, unit", "96.1235, unit")
        .replace("{ unit = \"N s/mm\", value = 0.3, std = 0.15 }", "{ unit = \"N s/mm\", value = 0.412 }")
        .replace("{unit=\"V\"}", "{ unit = \"V\", hold = \"band_limited\" }")
        .replace("initial = 5", "initial = [1.0, 2.0]")
        .replace("\"drive\"", "\"drive, improved\"")
        .replace(
            "fixed = true }\n",
            "fixed = true }\nfc = { value = 20.1234567, unit = \"N\" }  # 95 % interval [19, 21]\nso = { value = 1.5, unit = \"mm\" }\n",
        )
        .replace("M*q''+Fv * q' = kt*i", "M*q'' + Fv*q' + fc*sign(q') = kt*i")
        + "\n[measurements]\nq = \"q + so\"\n";
    assert_eq!(written, expected);
    let mut again = load(&written);
    assert_eq!(again.parameters[0].value, 96.1235);
    again.parameters[0].value = 96.123_456_789;
    assert_eq!(again, model);
}

#[test]
fn a_range_stays_as_written_until_it_changes() {
    let (text, _) = drive();
    let text = text.replace("{unit=\"V\"}", "{unit=\"mV\", range = [-1_000, 2.5e3]}");
    let mut model = load(&text);
    assert_eq!(write(&model, &text), text);
    model.inputs[0].range = Some([-1.0, 2.0]);
    let changed = write(&model, &text);
    assert_eq!(changed, text.replace("[-1_000, 2.5e3]", "[-1000.0, 2000.0]"));
    assert_eq!(load(&changed).inputs[0].range, Some([-1.0, 2.0]));
    model.inputs[0].range = None;
    assert!(!write(&model, &text).contains("range"));
}

#[test]
fn new_states_come_with_their_equations() {
    let (text, mut model) = drive();
    model.replace("u", 0, &Expr::var("ua"));
    let unit = model.inputs[0].unit.clone();
    model.states.push(State { name: "ua".into(), unit, order: 1, channel: None, initial: vec![] });
    let ta =
        Parameter { name: "ta".into(), value: 0.01, unit: None, std: None, fixed: false, positive: None };
    model.parameters.push(ta);
    let lhs = parse("ta*ua' + ua").unwrap().expr;
    model.equations.push(Equation { name: "actuator".into(), lhs, rhs: Expr::var("u") });
    model.measurements.push(Measurement {
        channel: "drive current".into(),
        expr: parse("1000*i").unwrap().expr,
        unit: Unit::parse("mA").unwrap(),
    });
    model.resolve_units().unwrap();
    let written = write(&model, &text);
    assert!(written.contains("coil = \"L*i' = ua/R - i\""), "{written}");
    assert!(written.contains("ua = { unit = \"V\", measured = false }\n"), "{written}");
    assert!(written.contains("\"drive current\" = { expression = \"1000*i\", unit = \"mA\" }"), "{written}");
    assert_eq!(load(&written), model);
    // And away again.
    let mut fewer = model.clone();
    fewer.measurements.pop();
    fewer.states.pop();
    fewer.equations.pop();
    fewer.parameters.pop();
    fewer.replace("ua", 0, &Expr::var("u"));
    let back = write(&fewer, &written);
    assert!(
        !back.contains("ua = ") && !back.contains("actuator") && !back.contains("[measurements]"),
        "{back}"
    );
    assert_eq!(load(&back), fewer);
}

#[test]
fn all_layouts_of_toml_are_kept() {
    let text = "states = { x = { unit = \"m\" } }\nparameters.k = { value = 1, unit = \"1/s\" }\n\
                [equations]\ne = \"\"\"\nx' = -k*x\"\"\"\n";
    let mut model = load(text);
    assert_eq!(write(&model, text), text);
    model.parameters[0].value = 2.0;
    model.parameters.push(Parameter {
        name: "c".into(),
        value: 3.0,
        unit: None,
        std: Some(1.0),
        fixed: false,
        positive: None,
    });
    model.add_term(0, parse("-c").unwrap().expr);
    model.resolve_units().unwrap();
    for original in [
        text,
        "[parameters.k]\nvalue = 1\nunit = \"1/s\"\n[states.x]\nunit = \"m\"\n[equations]\n",
        "= no toml",
    ] {
        let comments = [("c".to_owned(), "new".to_owned())];
        let written = model.to_toml(&WriteOptions { original: Some(original), comments: &comments });
        let mut again = load(&written);
        again.parameters.sort_by(|a, b| b.name.cmp(&a.name));
        assert_eq!(again, model, "{written}");
        assert!(written.contains("x' - c = -k*x"), "{written}");
    }
}

#[test]
fn without_an_original_the_text_is_tidy() {
    let (_, model) = drive();
    let written = model.to_toml(&WriteOptions::default());
    assert_eq!(
        written,
        r#"name = "drive"

[inputs]
u = { unit = "V" }

[states]
q = { unit = "mm", initial = 5.0 }
i = { unit = "A", measured = false }

[parameters]
M = { value = 95.0, unit = "kg", std = 10.0 }
Fv = { value = 0.3, unit = "N s/mm", std = 0.15 }
kt = { value = 35.15065, unit = "N/A" }
R = { value = 2.0, unit = "Ohm" }
L = { value = 0.01, unit = "s", fixed = true }

[equations]
axis = "M*q'' + Fv*q' = kt*i"
coil = "L*i' = u/R - i"
"#
    );
    assert_eq!(load(&written), model);
}

#[test]
fn editing_helpers() {
    let (_, mut model) = drive();
    let before = model.clone();
    model.add_term(0, parse("0*q").unwrap().expr);
    model.add_term(99, parse("q").unwrap().expr);
    assert_eq!(model, before);
    model.add_term(0, parse("-M*q/L^2").unwrap().expr);
    model.add_term(0, parse("M*(q - 2*q)/L^2 + -3*Fv*q'").unwrap().expr);
    assert_eq!(model.equations[0].to_string(), "M*q'' + Fv*q' - M*q/L^2 + M*(q - 2*q)/L^2 - 3*Fv*q' = kt*i");
    model.add_term(1, parse("L^3*i'''").unwrap().expr);
    assert_eq!(model.states[1].order, 3);
    assert_eq!(model.fresh_name("sin"), "sin_2");
    assert_eq!(model.fresh_name("t"), "t_2");
    assert_eq!(model.fresh_name("fc"), "fc");
    let mut zero = before;
    zero.equations[0].lhs = Expr::Num(0.0);
    zero.add_term(0, parse("-M*q''").unwrap().expr);
    assert_eq!(zero.equations[0].to_string(), "-M*q'' = kt*i");
}

proptest! {
    #[test]
    fn any_values_survive(value in -1e6..1e6f64, tiny in 1e-12..1e-6f64, std in 1e-3..1e3f64, start in -90.0..90.0f64) {
        let round = |v: f64| format!("{v:.5e}").parse::<f64>().expect("a number");
        let text = "[states]\nx = { unit = \"deg\" }\n[parameters]\nk = { value = 1, unit = \"1/min\" }\nc = { value = 1, unit = \"km/h\" }\n\
                    [equations]\ne = \"x' = -k*x + 0*c\"\n";
        let mut model = load(text);
        model.parameters[0].value = round(value) * model.parameters[0].unit.as_ref().map_or(1.0, |u| u.factor);
        model.parameters[0].std = Some(std);
        model.parameters[1].value = tiny;
        model.states[0].initial = vec![start];
        for original in [None, Some(text)] {
            let written = model.to_toml(&WriteOptions { original, ..Default::default() });
            let again = load(&written);
            prop_assert_eq!(again.parameters[0].value, model.parameters[0].value);
            let near = |a: f64, b: f64| (a - b).abs() <= 5.1e-6 * b.abs();
            prop_assert!(near(again.parameters[0].std.unwrap_or(0.0), std));
            prop_assert!(near(again.parameters[1].value, tiny));
            prop_assert!(near(again.states[0].initial[0], start));
            // Written again, nothing moves any more.
            prop_assert_eq!(again.to_toml(&WriteOptions { original: Some(&written), ..Default::default() }), written);
        }
    }
}

#[test]
fn declared_units_and_temperatures_are_written_back() {
    let text = r#"[units]
enc   = "2*pi/4096 rad"   # encoder
dose  = "own"
gross = { value = 144, unit = "1" }
score = 20                # bare

[inputs]
u = { unit = 'dose/s' }

[states]
theta = { unit = "enc", initial = [4096, 1] }
c = { unit = "dose" }
Ti = { unit = "degC", initial = 20 }

[parameters]
T = { value = 2, unit = "s" }
k = { value = 5 }
To = { value = 21.5, unit = "degC", std = 2 }

[equations]
a = "T^2*theta'' + theta = k*c"
b = "T*c' + c = T*u"
r = "T*Ti' + Ti = To"
"#;
    let model = Model::from_toml(text, "m.toml").unwrap();
    assert!((model.states[0].initial[0] - std::f64::consts::TAU).abs() < 1e-12);
    let same = model.to_toml(&WriteOptions { original: Some(text), ..Default::default() });
    assert_eq!(same, text);
    let fresh = model.to_toml(&WriteOptions::default());
    assert!(fresh.starts_with("[units]\nenc = \"2*pi/4096 rad\"\n"), "{fresh}");
    let again = Model::from_toml(&fresh, "m.toml").unwrap();
    assert_eq!(again.units.iter().map(|u| &u.symbol).collect::<Vec<_>>(), ["enc", "dose", "gross", "score"]);
    let with = |m: &Model| {
        let mut m = m.clone();
        m.units = greybox_model::Units::default();
        m
    };
    assert_eq!(with(&again), with(&model), "{fresh}");
    assert!(fresh.contains("To = { value = 21.5, unit = \"degC\", std = 2.0 }"), "{fresh}");

    // A changed value comes back on its own scale, its deviation as a difference.
    let mut changed = model.clone();
    let to = changed.parameter("To").unwrap();
    (changed.parameters[to].value, changed.parameters[to].std) = (303.15, Some(0.5));
    changed.states[2].initial = vec![273.15];
    let written = changed.to_toml(&WriteOptions { original: Some(text), ..Default::default() });
    assert!(written.contains("To = { value = 30.0, unit = \"degC\", std = 0.5 }"), "{written}");
    assert!(written.contains("Ti = { unit = \"degC\", initial = 0.0 }"), "{written}");
    assert!(written.starts_with("[units]\nenc   = \"2*pi/4096 rad\"   # encoder\n"));
}
