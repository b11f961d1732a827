//! The model language as a user meets it: whole files, good and bad.

use greybox_model::{Dimension, Hold, Model, ModelError, Unit, parse};
use std::path::PathBuf;

/// The flexible link of the documentation.
const LINK: &str = r#"name = "Rotary flexible link, linear nominal"

[inputs]
v = { unit = "V", hold = "linear" }      # the channel name defaults to the key

[states]
theta = { unit = "rad" }                 # measured by the channel of the same name
alpha = { unit = "rad", channel = "alpha" }

[parameters]
J  = { value = 0.0021, unit = "kg m^2", std = 0.0002 }
Jl = { value = 0.0019, unit = "kg m^2" }
B  = { value = 0.004, unit = "N m s/rad" }
Bl = { value = 0.0001 }
ks = { value = 1.3, unit = "N m/rad" }
kt = { value = 0.50, unit = "N m/V", fixed = true }     # known exactly: never moved

[equations]
hub  = "J*theta'' + B*theta' - ks*alpha = kt*v"
link = "Jl*(theta'' + alpha'') + Bl*alpha' + ks*alpha = 0"
"#;

/// The text with `from` replaced by `to`, which must be there.
fn with(text: &str, from: &str, to: &str) -> String {
    assert!(text.contains(from), "{from} is not in the text");
    text.replace(from, to)
}

#[test]
fn reads_the_flexible_link() {
    let model = Model::from_toml(LINK, "link.toml").unwrap();
    assert_eq!(model.name, "Rotary flexible link, linear nominal");
    assert_eq!((model.inputs[0].channel.as_str(), model.inputs[0].hold), ("v", Hold::Linear));
    let orders: Vec<usize> = model.states.iter().map(|s| s.order).collect();
    assert_eq!(orders, [2, 2]);
    let names: Vec<&str> = model.parameters.iter().map(|p| p.name.as_str()).collect();
    assert_eq!(names, ["J", "Jl", "B", "Bl", "ks", "kt"]);
    assert_eq!(model.parameters[0].std, Some(0.0002));
    assert!(model.parameters[5].fixed);
    assert_eq!(model.parameters[3].unit.as_ref().unwrap().text, "N m s");
    assert_eq!(model.equations[0].to_string(), "J*theta'' + B*theta' - ks*alpha = kt*v");
    assert_eq!(model.measurements.len(), 2);
    let torque = model.dimension_of(&parse("kt*v").unwrap().expr).unwrap();
    assert_eq!(torque, Unit::parse("N m").unwrap().dimension);
}

#[test]
fn values_become_si_at_the_edge() {
    let text = r#"
        [inputs]
        u = { unit = "mA", channel = "current", hold = "zero", range = [-250, 500] }
        [states]
        y = { unit = "deg", initial = [90, 180] }
        i = { unit = "A", measured = false, initial = 1 }
        [parameters]
        gap = { value = 5, unit = "mm", std = 1 }
        hex = { value = 0x10 }
        c   = { value = 60, unit = "rpm" }
        r   = { value = 2 }
        [equations]
        a = "y'' + c*y' + deadzone(gap*r, gap)/gap*c^2*y = 0*i"
        b = "i' = c*u + hex*i"
        [measurements]
        y = "y + delay(y, 1/c)"
        i_meas = { expression = "i*1", unit = "mA" }
    "#;
    let model = Model::from_toml(text, "si.toml").unwrap();
    assert_eq!(model.inputs[0].hold, Hold::Zero);
    assert_eq!(model.inputs[0].range, Some([-0.25, 0.5]));
    assert_eq!(
        model.states[0].initial,
        [90.0 * (std::f64::consts::PI / 180.0), 180.0 * (std::f64::consts::PI / 180.0)]
    );
    assert_eq!((model.parameters[0].value, model.parameters[0].std), (0.005, Some(0.001)));
    assert_eq!(model.parameters[1].value, 16.0);
    assert_eq!(model.parameters[1].unit.as_ref().unwrap().text, "1/s");
    let channels: Vec<(&str, &str)> =
        model.measurements.iter().map(|m| (m.channel.as_str(), m.unit.text.as_str())).collect();
    assert_eq!(channels, [("y", "deg"), ("i_meas", "mA")]);
}

#[test]
fn the_fault_is_cloneable_and_sendable() {
    fn check<T: Send + Sync + Clone + std::error::Error + 'static>() {}
    check::<ModelError>();
}

#[test]
fn infers_units_across_equations() {
    // Bouc-Wen: kh through the first equation, be and ga through the second.
    let text = r#"
        [inputs]
        u = { unit = "N" }
        [states]
        y = { unit = "m" }
        z = { unit = "m", measured = false, initial = 0 }
        [parameters]
        m  = { value = 2, unit = "kg" }
        c  = { value = 10 }
        kh = { value = 5e4 }
        be = { value = 1e3 }
        ga = { value = 800 }
        fc = { value = 1 }
        vs = { value = 0.1 }
        n  = { value = 1 }
        unused = { value = 1 }
        [equations]
        mass = "m*y'' + c*y' + kh*z + fc*exp(-(y'/vs)^2)*sign(y')*(1 + sin(n*y)) = u"
        hysteresis = "z' = y' - be*abs(y')*z - ga*y'*abs(z)"
    "#;
    let model = Model::from_toml(text, "bw.toml").unwrap();
    let unit = |name: &str| model.parameters[model.parameter(name).unwrap()].unit.clone().unwrap().text;
    for (name, expected) in [
        ("c", "N s/m"),
        ("kh", "N/m"),
        ("be", "1/m"),
        ("ga", "1/m"),
        ("fc", "N"),
        ("vs", "m/s"),
        ("n", "1/m"),
        ("unused", "1"),
    ] {
        assert_eq!(unit(name), expected, "{name}");
    }
    // A state without a unit is inferred too.
    let free = with(text, "z = { unit = \"m\", ", "z = { ");
    assert_eq!(Model::from_toml(&free, "bw.toml").unwrap().states[1].unit.text, "m");
}

#[test]
fn dimension_of_takes_the_whole_language() {
    let model = Model::from_toml(LINK, "link.toml").unwrap();
    let of = |text: &str| model.dimension_of(&parse(text).unwrap().expr);
    for (text, unit) in [
        ("sqrt(ks/J)", "1/s"),
        ("J^0.5*J^(1/2)", "kg m^2"),
        ("sign(v)*t", "s"),
        ("max(v, 0)", "V"),
        ("saturate(v, 2*v) - deadzone(v, v)", "V"),
        ("delay(v, 3*t)", "V"),
        ("step(t, 0)*v", "V"),
        ("2*pi", "1"),
        ("exp(theta)^alpha", "1"),
        ("0", "1"),
        ("abs(-v)/v", "1"),
    ] {
        assert_eq!(of(text).unwrap(), Unit::parse(unit).unwrap().dimension, "{text}");
    }
    assert_eq!(of("v/v"), Ok(Dimension::NONE));
    for (text, fragment) in [
        ("sin(v)", "the argument of `sin` must be dimensionless, but `v` is in V"),
        ("delay(v, v)", "the delay of `delay` must be in s"),
        ("v^theta", "the exponent of `v^theta` must be a number"),
        ("2^v", "the exponent of `2^v` must be dimensionless"),
        ("v + 1", "the term `1` is in 1 (dimensionless), but `v` is in V"),
        ("max(v, t)", "the term `t` is in s"),
        ("w", "`w` is not defined"),
    ] {
        let error = of(text).unwrap_err().to_string();
        assert!(error.contains(fragment), "{text}: {error}");
    }
}

/// Text, what to put for it, line and column of the fault, fragments of the message.
type Case = (&'static str, &'static str, (usize, usize), &'static [&'static str]);

/// A change of the flexible link → where the fault is found, and what its message says.
#[test]
fn bad_files_name_place_and_help() {
    let hub = "J*theta'' + B*theta' - ks*alpha = kt*v";
    let cases: &[Case] = &[
        // TOML
        ("name = ", "name ", (1, 6), &["not TOML"]),
        ("hub  =", "link =", (20, 1), &["not TOML", "duplicate key"]),
        // keys and values
        ("[parameters]", "[paramters]", (10, 2), &["unknown key `paramters`", "did you mean `parameters`"]),
        ("hold = \"linear\"", "hold = \"spline\"", (4, 26), &["unknown hold \"spline\"", "band_limited"]),
        (
            "hold = \"linear\"",
            "range = 10",
            (4, 27),
            &["`range` must be two rising numbers", "range = [-10, 10]"],
        ),
        ("hold = \"linear\"", "range = [1, 2, 3]", (4, 27), &["input `v`", "found 3 in a list"]),
        ("hold = \"linear\"", "range = [5, -5]", (4, 27), &["found one that is not below the other"]),
        ("hold = \"linear\"", "range = [-5, \"a\"]", (4, 32), &["`range` must be a number"]),
        ("hold = \"linear\"", "holds = \"linear\"", (4, 19), &["unknown key `holds` in input `v`", "`hold`"]),
        ("std = 0.0002", "std = -1", (11, 47), &["parameter `J`", "`std` must be positive, found -1"]),
        ("value = 0.0021", "value = nan", (11, 16), &["finite", "nan"]),
        ("value = 0.0021", "value = \"2\"", (11, 16), &["`value` must be a number", "without quotes"]),
        ("value = 0.0021, ", "", (11, 6), &["parameter `J` lacks `value`"]),
        ("{ value = 0.0001 }", "0.0001", (14, 6), &["expected a table", "Bl = { value = 0.0001 }"]),
        ("fixed = true", "fixed = 1", (16, 46), &["`fixed` must be true or false"]),
        ("kg m^2\", std", "kg m2\", std", (11, 35), &["parameter `J`", "`kg m2`", "write `m^2`"]),
        ("N m/V", "Nm/V", (16, 30), &["unknown unit `Nm`", "write `N m` with a space"]),
        // names
        ("Bl = {", "v = {", (14, 1), &["`v` is an input and a parameter"]),
        ("Bl = {", "sin = {", (14, 1), &["`sin` cannot name a parameter", "function"]),
        ("Bl = {", "t = {", (14, 1), &["it is the time"]),
        ("Bl = {", "\"B-l\" = {", (14, 1), &["a letter, then letters", "write `B_l`"]),
        (
            "ks*alpha = kt*v",
            "ks*alfa = kt*v",
            (19, 35),
            &["equation \"hub\"", "`alfa` is not defined", "declare `alfa`"],
        ),
        ("ks*alpha = kt*v", "ks*alpa = kt*v", (19, 35), &["did you mean `alpha`?"]),
        ("B*theta'", "B*theta_dot", (19, 23), &["primes: `theta'`"]),
        (
            "kt*v",
            "kt*v'",
            (19, 46),
            &["an input has no primes", "`dv = { unit = \"V/s\", channel = \"v'\" }`", "and write `dv`"],
        ),
        ("kt*v", "kt'*v", (19, 43), &["a parameter is constant"]),
        // syntax
        (hub, "J*theta'' + B*theta' - ks*alpha", (19, 40), &["equation \"hub\"", "needs one `=`", "`= 0`"]),
        ("J*theta''", "2J*theta''", (19, 10), &["write `2*J`"]),
        ("ks*alpha = kt", "ks*sine(alpha) = kt", (19, 35), &["unknown function `sine`", "`sin`"]),
        // structure
        (
            "link = \"Jl*(theta'' + alpha'') + Bl*alpha' + ks*alpha = 0\"\n",
            "",
            (8, 1),
            &["the state `alpha` never appears with a prime"],
        ),
        ("link = ", "more = \"theta'' = 0*kt/J*v\"\nlink = ", (21, 8), &["3 equations for 2 states"]),
        ("J*theta''", "J*sin(theta'')", (19, 9), &["`J*sin(theta'')` is not affine", "inside `sin`"]),
        (
            "J*theta''",
            "J*theta''^2",
            (19, 9),
            &["the term `J*theta''^2` is not affine in the highest derivative `theta''`"],
        ),
        ("ks*alpha = kt*v", "B*sign(theta'' - alpha'') = kt*v", (19, 32), &["not affine", "inside `sign`"]),
        (
            "J*theta'' + B",
            "0*theta'' + B",
            (19, 8),
            &["equation \"hub\" cannot be solved", "no highest derivative"],
        ),
        (
            "Jl*(theta'' + alpha'')",
            "Jl*(theta'' + 0*alpha'')",
            (20, 8),
            &[
                "equation \"link\" cannot be solved",
                "it contains `theta''`, which \"hub\" determines already; no equation is left for `alpha''`",
                "write one that contains `alpha''`",
            ],
        ),
        ("kt*v", "kt*step(theta, 1)", (19, 46), &["must be the time `t`", "write `step(t, 1)`"]),
        ("kt*v", "kt*delay(v, alpha)", (19, 46), &["must consist of parameters and numbers, found `alpha`"]),
        ("kt*v", "kt*delay(v, -J)", (19, 46), &["the delay is negative"]),
        // measurements
        ("channel = \"alpha\"", "channel = \"theta\"", (8, 1), &["channel `theta` measures `theta` already"]),
        (
            "channel = \"alpha\"",
            "channel = \"alpha\", measured = false",
            (8, 35),
            &["names a channel, but `measured = false`"],
        ),
        (
            "channel = \"alpha\"",
            "initial = [0, 0, 1]",
            (8, 1),
            &["`initial` has 3 values, its order is 2", "[alpha, alpha']"],
        ),
        // units
        (
            "B*theta' -",
            "B*theta -",
            (19, 21),
            &[
                "equation \"hub\"",
                "the term `B*theta` is in N m s, but `J*theta''`, `ks*alpha`, `kt*v` are in N m",
                "check the unit of `B`, stated as N m s/rad: with N m",
            ],
        ),
        (
            "J*theta''",
            "5 + J*theta''",
            (19, 9),
            &["the term `5` is in 1 (dimensionless)", "a parameter with the unit N m"],
        ),
        ("kt*v", "kt*v*sin(v)", (19, 48), &["the argument of `sin` must be dimensionless, but `v` is in V"]),
        ("Bl*alpha'", "Bl*alpha' + Bl*alpha", (20, 46), &["no unit of `Bl` lets the term `Bl*alpha` share"]),
    ];
    let mut wrong = Vec::new();
    for (from, to, place, fragments) in cases {
        let text = with(LINK, from, to);
        let error = match Model::from_toml(&text, "link.toml") {
            Err(error) => error,
            Ok(_) => panic!("{to} was accepted"),
        };
        let message = error.to_string();
        for fragment in *fragments {
            if !message.contains(fragment) {
                wrong.push(format!("{to}: {message}\n    lacks {fragment}"));
            }
        }
        let expected = format!("link.toml:{}:{}: ", place.0, place.1);
        if !message.starts_with(&expected) {
            wrong.push(format!("{to}: {message}\n    expected at {expected}"));
        }
        assert_eq!(error.file(), Some("link.toml"));
        assert!(error.span().is_some_and(|s| s.end <= text.len() && text.get(s).is_some()), "{to}");
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

#[test]
fn explicit_measurements_replace_and_conflict() {
    let text = format!("{LINK}[measurements]\nalpha = \"alpha + J/J\"\nenc = \"2*theta'\"\n");
    let model = Model::from_toml(&text, "m.toml").unwrap();
    let channels: Vec<String> =
        model.measurements.iter().map(|m| format!("{}: {}", m.channel, m.expr)).collect();
    assert_eq!(channels, ["theta: theta", "alpha: alpha + J/J", "enc: 2*theta'"]);
    for (from, to, fragment) in [
        ("channel = \"alpha\"", "channel = \"a2\"", "measured by channel `a2`, and by this expression too"),
        ("2*theta'", "2*theta'''", "the equations know derivatives up to `theta''`"),
        ("2*theta'", "2*theto", "measurement \"enc\": `theto` is not defined"),
        ("2*theta'", "theta + v", "measurement \"enc\": the term `v`"),
        (
            "\"2*theta'\"",
            "{ expression = \"2*theta'\", unit = \"V\" }",
            "its unit is V, but `2*theta'` is in 1/s",
        ),
        ("\"2*theta'\"", "{ unit = \"V\" }", "lacks `expression`"),
        ("\"2*theta'\"", "3", "expected a string, found the number 3"),
    ] {
        let error = Model::from_toml(&with(&text, from, to), "m.toml").unwrap_err().to_string();
        assert!(error.contains(fragment), "{to}: {error}");
    }
}

#[test]
fn contradictory_inference_is_an_error() {
    let text = "[states]\nx = { unit = \"m\" }\n[parameters]\np = { value = 1 }\n[equations]\ne = \"p*x' + p*x = 0\"\n";
    let error = Model::from_toml(text, "p.toml").unwrap_err().to_string();
    assert!(error.starts_with("p.toml:6:13: equation \"e\": no unit of `p` lets the term `p*x`"), "{error}");
}

#[test]
fn escaped_strings_still_have_a_place() {
    let text = "[states]\nx = { unit = \"m\" }\n[equations]\ne = \"x' + \\u0079 = 0\"\nf = '''\nx' = 0'''";
    let error = Model::from_toml(text, "e.toml").unwrap_err();
    assert!(error.to_string().starts_with("e.toml:4:5: equation \"e\": `y` is not defined"), "{error}");
    let text = "[states]\nx = { unit = \"m\" }\n[equations]\nf = '''\nx' = y'''";
    let error = Model::from_toml(text, "e.toml").unwrap_err();
    assert!(error.to_string().starts_with("e.toml:5:6: "), "{error}");
}

/// The nominal models that come with the reference recordings.
#[test]
fn nominal_models_of_the_recordings_load() {
    let folder = std::env::var_os("GREYBOX_RECORDINGS").map(PathBuf::from);
    let Some(folder) = folder.filter(|f| f.is_dir()) else {
        println!("skipped: GREYBOX_RECORDINGS names no folder");
        return;
    };
    let mut loaded = 0;
    for entry in std::fs::read_dir(&folder).unwrap() {
        let entry = entry.unwrap().path();
        let Ok(files) = std::fs::read_dir(&entry) else { continue };
        for file in files {
            let file = file.unwrap().path();
            if file.extension().is_some_and(|e| e == "toml") {
                let text = std::fs::read_to_string(&file).unwrap();
                let model =
                    Model::from_toml(&text, &file.display().to_string()).unwrap_or_else(|e| panic!("{e}"));
                assert!(model.parameters.iter().all(|p| p.unit.is_some()));
                loaded += 1;
            }
        }
    }
    assert!(loaded >= 5, "only {loaded} models in {}", folder.display());
}

#[test]
fn nothing_makes_loading_panic() {
    // Every prefix, and every single character left out.
    for (end, _) in LINK.char_indices() {
        let _ = Model::from_toml(&LINK[..end], "x.toml");
        let mut text = LINK.to_owned();
        text.remove(end);
        let _ = Model::from_toml(&text, "x.toml");
    }
}

const ROOM: &str = r#"
[units]
enc = "2*pi/4096 rad"

[inputs]
Ta = { unit = "degC" }
Ph = { unit = "W" }

[states]
Ti = { unit = "degF", initial = [212] }

[parameters]
C = { value = 2e6, unit = "J/degC" }
R = { value = 0.005, unit = "degC/W", std = 0.001 }
To = { value = -10, unit = "degC", std = 9, positive = true }
gain = { value = 0 }

[equations]
room = "C*Ti' + (Ti - Ta)/R + gain*(Ti - To) = Ph"

[measurements]
rise = "Ti - Ta"
mean = { expression = "(Ti + Ta)/2", unit = "degC" }
"#;

#[test]
fn temperatures_are_absolute_in_kelvin_and_their_differences_differences() {
    let model = Model::from_toml(ROOM, "room.toml").unwrap();
    assert!((model.states[0].initial[0] - 373.15).abs() < 1e-9);
    assert_eq!((model.parameters[0].value, model.parameters[1].value), (2e6, 0.005));
    assert_eq!((model.parameters[2].value, model.parameters[2].std), (263.15, Some(9.0)));
    assert_eq!(model.parameters[3].unit.as_ref().unwrap().text, "W/K");
    let unit = |channel: &str| {
        let m = model.measurements.iter().find(|m| m.channel == channel).unwrap();
        (m.unit.text.clone(), m.unit.offset)
    };
    assert_eq!(unit("Ti").0, "degF");
    assert_eq!((unit("rise"), unit("mean")), (("K".to_owned(), 0.0), ("degC".to_owned(), 273.15)));
    // A difference has no zero.
    let wrong = ROOM.replace("rise = \"Ti - Ta\"", "rise = { expression = \"Ti - Ta\", unit = \"degC\" }");
    let error = Model::from_toml(&wrong, "room.toml").unwrap_err();
    assert!(error.to_string().contains("is a difference; help: write `unit = \"K\"`"), "{error}");
}

#[test]
fn units_that_a_model_declares() {
    let model = |units: &str| {
        let text = format!(
            "[units]\n{units}\n[inputs]\nu = {{ unit = \"bolus/s\" }}\n[states]\nx = {{ unit = \"bolus\", initial = 3 }}\n\
             [parameters]\nT = {{ value = 2, unit = \"s\" }}\n[equations]\ne = \"x' = u - x/T\"\n"
        );
        Model::from_toml(&text, "m.toml")
    };
    let own = model("bolus = \"own\"").unwrap();
    assert_eq!((own.states[0].initial[0], own.states[0].unit.dimension.to_string()), (3.0, "bolus".into()));
    // A definition may use what stands below it.
    for units in [
        "bolus = \"2 half\"\nhalf = \"0.25 kg\"",
        "bolus = { value = 0.5, unit = \"kg\" }",
        "lot = \"own\"\nbolus = \"0.5 kg\"",
    ] {
        let model = model(units).unwrap();
        assert_eq!((model.states[0].initial[0], model.states[0].unit.factor), (1.5, 0.5), "{units}");
    }
    assert_eq!(model("bolus = 4").unwrap().states[0].initial[0], 12.0);
    for (units, problem) in [
        ("", "unknown unit `bolus`"),
        ("bolus = true", "expected a definition, found true"),
        (
            "bolus = \"2 furlong\"",
            "m.toml:2:12: unit `bolus`: the unit `2 furlong` cannot be read: unknown unit `furlong`",
        ),
        (
            "mm = \"2 kg\"",
            "m.toml:2:1: `mm` cannot name a unit: it is a built-in unit; help: choose another symbol, such as `mm_`",
        ),
        ("x2 = \"2 kg\"", "a unit's symbol consists of letters and `_`; help: write `x`"),
        (
            "bolus = \"2 lot\"\nlot = \"3 bolus\"",
            "unit `bolus`: its definition leads through `lot` back to itself",
        ),
        ("bolus = \"2 bolus\"", "unit `bolus`: its definition leads through `bolus` back to itself"),
        ("bolus = { value = 2 }", "unit `bolus` lacks `unit`"),
        (
            "bolus = { value = 2, units = \"kg\" }",
            "unknown key `units` in unit `bolus`; help: did you mean `unit`?",
        ),
        ("a = \"own\"\nb = \"own\"\nc = \"own\"\nd = \"own\"\nbolus = \"own\"", "at most 4 dimensions"),
        ("bolus = \"own\"\nbolus = \"kg\"", "not TOML"),
    ] {
        let error = model(units).unwrap_err().to_string();
        assert!(error.contains(problem), "{units}: {error}");
    }
    let long = format!("bolus = \"2{} kg\"", " ".repeat(2000));
    assert!(model(&long).unwrap_err().to_string().contains("longer than 1000 bytes"));
    let many: String = (0..600).map(|k| format!("s_{} = 1\n", "q".repeat(k + 1))).collect();
    assert!(model(&many).unwrap_err().to_string().contains("at most 500 can be declared"));
}

#[test]
fn terms_in_different_declared_dimensions_do_not_add() {
    let text = "[units]\ndose = \"own\"\nlot = \"own\"\n[states]\nx = { unit = \"dose\" }\ny = { unit = \"lot\" }\n[parameters]\n\
                T = { value = 2, unit = \"s\" }\nk = { value = 3 }\n[equations]\ne = \"T*x' + x = k*y\"\nf = \"T*y' + y = 0\"\n";
    let model = Model::from_toml(text, "m.toml").unwrap();
    assert_eq!(model.parameters[1].unit.as_ref().unwrap().text, "dose/lot");
    let error = Model::from_toml(&text.replace("k*y", "y"), "m.toml").unwrap_err().to_string();
    assert!(error.contains("dose") && error.contains("lot"), "{error}");
}
