//! Whole models in other languages: what the text says, what it refuses, and that no text of a model becomes code.
//! That the Python module computes what `greybox simulate` computes is the business of the command's tests.

use greybox_export::{ExportError, latex, latex_document, modelica, python};
use greybox_model::{Model, parse};

const AXIS: &str = r#"
name = "Feed axis"
[inputs]
i = { unit = "A", hold = "zero" }
[states]
x = { unit = "mm", initial = [2, 0] }
theta_m = { unit = "rad", measured = false }
[parameters]
m = { value = 12, unit = "kg" }
fc = { value = 20, unit = "N" }
kf = { value = 35, unit = "N/A" }
k = { value = 2e5, unit = "N/m" }
r = { value = 1.5, unit = "mm" }
gap = { value = 10, unit = "mm" }
Jm = { value = 1e-4, unit = "kg m^2" }
tau = { value = 2, unit = "ms" }
[equations]
slide = "m*x'' + fc*sign(x') + k*deadzone(x - r*theta_m, gap) = 0"
motor = "Jm*theta_m'' - r*k*deadzone(x - r*theta_m, gap) = r*kf*delay(i, tau)"
"#;

fn axis() -> Model {
    Model::from_toml(AXIS, "axis.toml").unwrap()
}

#[test]
fn modelica_reads_like_the_model() {
    let expected = r#"  parameter Real m(unit = "kg") = 12;
  parameter Real fc(unit = "m.kg/s2") = 20;
  parameter Real kf(unit = "m.kg/(s2.A)") = 35;
  parameter Real k(unit = "kg/s2") = 200000;
  parameter Real r(unit = "m") = 0.0015;
  parameter Real gap(unit = "m") = 0.01;
  parameter Real Jm(unit = "m2.kg") = 0.0001;
  parameter Real tau(unit = "s") = 0.002;
  parameter Real sign_width(min = 0) = 1e-4 "Where sign(x) is a straight line: |x| < sign_width, SI of x";
  input Real i(unit = "A");
  Real x(unit = "m", start = 0.002, fixed = true);
  Real x_dot(start = 0, fixed = true) "x'";
  Real theta_m(unit = "rad", start = 0, fixed = true);
  Real theta_m_dot(start = 0, fixed = true) "theta_m'";
  output Real y_x(unit = "m") "x";
equation
  der(x) = x_dot;
  der(theta_m) = theta_m_dot;
  m*der(x_dot) + fc*(if x_dot > sign_width then 1 elseif x_dot < -sign_width then -1 else x_dot/sign_width) + k*(if x - r*theta_m > gap then x - r*theta_m - gap elseif x - r*theta_m < -gap then x - r*theta_m + gap else 0) = 0 "slide";
  Jm*der(theta_m_dot) - r*k*(if x - r*theta_m > gap then x - r*theta_m - gap elseif x - r*theta_m < -gap then x - r*theta_m + gap else 0) = r*kf*delay(i, tau) "motor";
  y_x = x;
end FeedAxis;
"#;
    let text = modelica(&axis()).unwrap();
    assert!(text.starts_with("model FeedAxis \"Feed axis\"\n"), "{text}");
    assert!(text.ends_with(expected), "{text}");
}

#[test]
fn latex_reads_like_a_textbook() {
    let expected = r"\begin{align}
  m\,\ddot{x} + \mathit{fc}\,\operatorname{sign}\left(\dot{x}\right) + k\,\operatorname{deadzone}\left(x - r\,\theta_{\text{m}}, \mathit{gap}\right) &= 0 \\
  \mathit{Jm}\,\ddot{\theta}_{\text{m}} - r\,k\,\operatorname{deadzone}\left(x - r\,\theta_{\text{m}}, \mathit{gap}\right) &= r\,\mathit{kf}\,i(t - \tau)
\end{align}
";
    assert_eq!(latex(&axis()), expected);
    let document = latex_document(&axis());
    for part in [
        expected,
        r"\title{Feed axis}",
        r"\operatorname{sign}(0) \in [-1, 1]",
        r"$\mathit{Jm}$ & $0.0001$ & kg m$^{2}$ \\",
        r"$k$ & $200000$ & N/m \\",
        r"$\tau$ & $2$ & ms \\",
        r"$\theta_{\text{m}}$ & state, not measured & rad \\",
    ] {
        assert!(document.contains(part), "{part} is not in:\n{document}");
    }
}

#[test]
fn a_long_equation_breaks_before_a_term() {
    let mut model = axis();
    model.equations[0].lhs = parse(
        "m*x'' + fc*sign(x') + k*deadzone(x - r*theta_m, gap) - k*x^2 + fc*sign(x')*abs(x) + k*x^3/(1 + x^2)",
    )
    .unwrap()
    .expr;
    let text = latex(&model);
    let lines: Vec<&str> = text.lines().collect();
    assert_eq!(
        lines[1..3],
        [
            r"  & m\,\ddot{x} + \mathit{fc}\,\operatorname{sign}\left(\dot{x}\right) + k\,\operatorname{deadzone}\left(x - r\,\theta_{\text{m}}, \mathit{gap}\right) - k\,x^{2} \notag \\",
            r"  & \quad {} + \mathit{fc}\,\operatorname{sign}\left(\dot{x}\right)\,\left|x\right| + \frac{k\,x^{3}}{1 + x^{2}} = 0 \\",
        ]
    );
    assert!(lines[3].starts_with(r"  & \mathit{Jm}") && lines[3].contains(" = r"), "{text}");
    assert_eq!(lines.len(), 5);
}

#[test]
fn quotients_and_signs_keep_their_value_in_latex() {
    let mut model = axis();
    for (text, expected) in [
        ("m*x'' - (fc - k*x)", r"m\,\ddot{x} - \left(\mathit{fc} - k\,x\right)"),
        ("m*x''*(-x)", r"m\,\ddot{x}\,\left(-x\right)"),
        ("m*x''/(k + fc)^2", r"\frac{m\,\ddot{x}}{\left(k + \mathit{fc}\right)^{2}}"),
        ("x^(-2) + 2*3 + x*1.5e-7", r"x^{-2} + 2 \cdot 3 + x \cdot 1.5 \cdot 10^{-7}"),
        ("(x/k)^2", r"\left(\frac{x}{k}\right)^{2}"),
        ("-(x + k)", r"-\left(x + k\right)"),
        ("sqrt(abs(x'''))", r"\sqrt{\left|\dddot{x}\right|}"),
        ("delay(x + k, tau)", r"\left.\left(x + k\right)\right|_{t - \tau}"),
        ("q_12_a + x1_2", r"q_{\text{12\_a}} + x_{1,\text{2}}"),
    ] {
        model.equations[0].lhs = parse(text).unwrap().expr;
        let latex = latex(&model);
        assert!(latex.contains(&format!("  {expected} &= 0")), "{text} is not {expected} in:\n{latex}");
    }
}

/// Text that would end a string, a comment or a command where nobody looks.
const HOSTILE: &str = "x\"\"\"\n'''\\\"*/ end; import os\r\u{2028}%$\\input{a}";

#[test]
fn text_of_a_model_is_never_code() {
    let mut model = axis();
    model.name = HOSTILE.into();
    model.equations[0].name = HOSTILE.into();
    model.measurements[0].channel = HOSTILE.into();
    model.parameters[0].unit.as_mut().unwrap().text = HOSTILE.into();
    model.inputs[0].unit.text = HOSTILE.into();
    let python = python(&model).unwrap();
    let benign = greybox_export::python(&axis()).unwrap();
    // Inside a string or behind a `#`, and so on as many lines as before.
    assert_eq!(python.lines().count(), benign.lines().count());
    let begins = |text: &str| -> Vec<String> {
        text.lines().map(|l| l.split(['"', '#']).next().unwrap().trim_end().to_owned()).collect()
    };
    assert_eq!(begins(&python), begins(&benign));
    let name = r#"NAME = "x\"\"\"\U0000000a'''\\\"*/ end; import os\U0000000d\U00002028%$\\input{a}""#;
    assert!(python.lines().any(|line| line == name), "{python}");
    // What else ends a line in Python.
    assert!(!python.contains(['\r', '\u{2028}']), "{python}");
    let modelica = modelica(&model).unwrap();
    assert_eq!(modelica.lines().count(), greybox_export::modelica(&axis()).unwrap().lines().count());
    assert!(
        modelica.starts_with(r#"model XEndImportOsInputA "x\"\"\" '''\\\"*/ end; import os"#),
        "{modelica}"
    );
    let document = latex_document(&model);
    assert!(!document.contains("\\input{a}") && !document.contains("%$"), "{document}");
    assert!(document.contains("\\textbackslash{}input\\{a\\}"), "{document}");
}

#[test]
fn words_of_the_languages_and_equal_identifiers_are_told_apart() {
    let text = r#"
[states]
lambda = { unit = "m" }
time = { unit = "m", channel = "der" }
[parameters]
end = { value = 3, unit = "1/s^2" }
lambda_dot = { value = 5, unit = "m/s" }
math = { value = 7, unit = "1/s" }
[equations]
class = "lambda'' + end*lambda + math*(lambda' - lambda_dot) = 0"
model = "time' + math*time = 0"
"#;
    let model = Model::from_toml(text, "m.toml").unwrap();
    let python = python(&model).unwrap();
    assert!(python.contains("(end, lambda_dot, math_2) = _p"), "{python}");
    assert!(python.contains("(lambda_2, lambda_dot_2, time) = _x"), "{python}");
    assert!(python.contains("end*lambda_2 + math_2*(lambda_dot_2 - lambda_dot)"), "{python}");
    let modelica = modelica(&model).unwrap();
    assert!(
        modelica.contains("der(lambda_dot_2) + end_2*lambda + math*(lambda_dot_2 - lambda_dot) = 0"),
        "{modelica}"
    );
    assert!(modelica.contains("der(time_2) + math*time_2 = 0"), "{modelica}");
}

#[test]
fn python_refuses_the_sign_of_a_delay_and_says_what_to_do() {
    let mut model = axis();
    model.equations[1].lhs = parse("Jm*theta_m'' + fc*sign(delay(x', tau))").unwrap().expr;
    let error = python(&model).unwrap_err();
    assert!(
        matches!(&error, ExportError::Refused { equation, function: "sign", .. } if equation == "motor"),
        "{error}"
    );
    assert!(error.to_string().contains("help: "), "{error}");
    // The others have no such trouble.
    assert!(modelica(&model).unwrap().contains("delay(x_dot, tau) > sign_width"));
}

#[test]
fn a_model_edited_into_nonsense_is_an_error() {
    let mut model = axis();
    model.equations.pop();
    assert!(matches!(python(&model), Err(ExportError::Compile(_))));
    assert!(matches!(modelica(&model), Err(ExportError::Compile(_))));
}

/// Modelica, Python and LaTeX of a model with a temperature scale and a dimension of its own.
#[test]
fn units_that_only_the_model_language_has() {
    let text = "[units]\ndose = \"own\"\n[states]\nT = { unit = \"degC\", initial = 20 }\nc = { unit = \"dose\" }\n[parameters]\n\
                tau = { value = 2, unit = \"s\" }\nTo = { value = 25, unit = \"degC\" }\nk = { value = 3 }\n\
                [equations]\nheat = \"tau*T' + T = To + k*c\"\nloss = \"tau*c' + c = 0\"\n";
    let model = Model::from_toml(text, "heat.toml").unwrap();
    let reported = modelica(&model).unwrap();
    assert!(reported.contains("parameter Real To(unit = \"K\") = 298.15;"), "{reported}");
    assert!(reported.contains("Real T(unit = \"K\", start = 293.15, fixed = true)"), "{reported}");
    assert!(reported.contains("parameter Real k = 3;") && !reported.contains("dose"), "{reported}");
    let reported = python(&model).unwrap();
    assert!(reported.contains("CHANNELS = {\"T\": (\"K\", 1), \"c\": (\"dose\", 1)}"), "{reported}");
    let reported = latex_document(&model);
    assert!(reported.contains("& $25$ & degC"), "{reported}");
}

/// A table is a variable with branches in Modelica, also inside another, and a small matrix in LaTeX.
#[test]
fn tables_are_written_out() {
    let text = "[inputs]\nf = {}\n[states]\nx = {}\n[parameters]\nm = { value = 2 }\nfa = { value = 1 }\n[equations]\n\
                valve = \"m*x'' + table(table(x, [0, 1], [0, 1]), [-1, 0.5], [-fa, fa^2]) = f\"\n";
    let model = Model::from_toml(text, "valve.toml").unwrap();
    let written = modelica(&model).unwrap();
    for line in [
        "  Real table;\n  Real table_2;\nequation\n",
        "  table = if table_2 <= -1 then (-fa) elseif table_2 < 0.5 then (-fa) + ((fa^2) - (-fa))*(table_2 - (-1))/1.5 \
         else (fa^2);\n",
        "  table_2 = if x <= 0 then 0 elseif x < 1 then 0 + (1 - 0)*(x - 0)/1 else 1;\n",
        "  m*der(x_dot) + table = f \"valve\";\n",
    ] {
        assert!(written.contains(line), "{line} is not in\n{written}");
    }
    let written = latex_document(&model);
    for part in [
        r"\operatorname{table}\left(\operatorname{table}\left(x;\; \begin{smallmatrix} 0 & 0 \\ 1 & 1 \end{smallmatrix}\right);",
        r"-1 & -\mathit{fa} \\ 0.5 & \mathit{fa}^{2} \end{smallmatrix}",
        r"\text{ linear between the values } v",
    ] {
        assert!(written.contains(part), "{part} is not in\n{written}");
    }
}
