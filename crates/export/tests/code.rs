//! The code compiles without a warning and gives what the expressions give.

use std::fmt::Write as _;
use std::path::Path;
use std::process::Command;

use greybox_export::{
    ChainForm, Constant, ExportError, Function, Group, Language, Member, ObserverCode, ObserverForm,
    StartForm, Vector,
};
use greybox_model::parse;
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;

fn function(outputs: &[&str]) -> Function {
    Function {
        name: "law".into(),
        summary: vec!["A law. */ // ends no comment".into()],
        arguments: vec![
            Group {
                name: "x".into(),
                members: vec![
                    Member::new("q", 0, "rad"),
                    Member::new("q", 1, "rad/s"),
                    Member::new("z", 0, ""),
                ],
            },
            Group { name: "r".into(), members: vec![Member::new("target", 0, "rad")] },
        ],
        constants: vec![
            Constant::new("k", 3.25, "N m/rad"),
            Constant::new("double", 1e-7, ""),
            Constant::new("φ", -2.0, "1"),
            Constant::new("x", 0.5, "named like an argument"),
            Constant::new("t0", 7.0, "named like a part"),
            Constant::new("unused", 9.0, ""),
        ],
        outputs: outputs.iter().map(|o| ("u, V".to_owned(), parse(o).unwrap().expr)).collect(),
    }
}

/// Everything that the language has, products and quotients in every nesting.
const OUTPUTS: [&str; 9] = [
    "saturate(k*(target - q) - q'/(1 + q^2) - (q - (z - q')), 4)",
    "sin(q)*cos(q') + tan(0.1*z) - exp(-q^2)*ln(2 + z^2)/sqrt(1 + q'^2)",
    "tanh(q'/0.05) + atan(3*q) + abs(q) + sign(q') + min(q, z) - max(q', z) + deadzone(q, 0.2) + table(q, [-1, 0.2, 1.5], [2, z, -k*q'])",
    "q - (q' - (z - target)) - q/((q' + 5)/(2 + z^2))",
    "-q^2 + (-q)^2 + (-q)^3 - 2^q + (3 + q)^-2 + (5 + q)^0.5 + q^0",
    "φ*double + x*t0 + pi",
    "-(-q) - -3*q' + (-2)*z - -(q*z)",
    "sin(q)*sin(q) + (target - q)*(target - q)*k",
    "q*(q'*z)/(k*(target + 10)) + k^5 + q^13",
];

fn vectors(function: &Function) -> Vec<Vector> {
    let mut generator = Pcg64Mcg::seed_from_u64(7);
    let mut points: Vec<Vec<f64>> =
        (0..200).map(|_| (0..4).map(|_| generator.random_range(-2.0..2.0)).collect()).collect();
    points.push(vec![0.0; 4]);
    points.push(vec![0.2, -0.0, 0.2, -1.0]);
    function.vectors(&points).unwrap()
}

/// Lines of numbers from the compiled program, compared with the vectors.
fn compare(program: &Path, vectors: &[Vector]) {
    let run = Command::new(program).output().unwrap();
    assert!(run.status.success());
    let text = String::from_utf8(run.stdout).unwrap();
    let lines: Vec<Vec<f64>> =
        text.lines().map(|l| l.split_whitespace().map(|v| v.parse().unwrap()).collect()).collect();
    assert_eq!(lines.len(), vectors.len());
    for (line, vector) in lines.iter().zip(vectors) {
        assert_eq!(line.len(), vector.outputs.len());
        for (k, (a, b)) in line.iter().zip(&vector.outputs).enumerate() {
            assert!(
                (a - b).abs() <= 1e-12 * (1.0 + b.abs()),
                "output {k} of {:?}: {a} and not {b}",
                vector.arguments
            );
        }
    }
}

fn rows(vectors: &[Vector], open: &str, close: &str) -> String {
    vectors.iter().fold(String::new(), |mut text, v| {
        let numbers: Vec<String> = v.arguments.iter().map(|a| format!("{a:?}")).collect();
        let _ = writeln!(text, "{open}{}{close},", numbers.join(", "));
        text
    })
}

#[test]
fn c_compiles_freestanding_and_agrees() {
    if Command::new("gcc").arg("--version").output().is_err() {
        println!("skipped: no C compiler here");
        return;
    }
    let function = function(&OUTPUTS);
    let (code, vectors) = (function.code(Language::C99).unwrap(), vectors(&function));
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    std::fs::write(path("law.c"), &code).unwrap();
    let main = format!(
        "#include <stdio.h>\nvoid law(const double x[3], const double r[1], double out[9]);\n\
         static const double in[{n}][4] = {{\n{}}};\n\
         int main(void) {{\n for (int i = 0; i < {n}; i++) {{\n  double out[9];\n  law(in[i], in[i] + 3, out);\n\
         for (int k = 0; k < 9; k++) printf(\"%.17g \", out[k]);\n  printf(\"\\n\");\n }}\n return 0;\n}}\n",
        rows(&vectors, "{", "}"),
        n = vectors.len()
    );
    std::fs::write(path("main.c"), main).unwrap();
    let strict =
        ["-std=c99", "-O2", "-ffreestanding", "-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Werror"];
    let object =
        Command::new("gcc").args(strict).arg("-c").arg(path("law.c")).arg("-o").arg(path("law.o")).output();
    let object = object.unwrap();
    assert!(object.status.success(), "{}\n{code}", String::from_utf8_lossy(&object.stderr));
    let files = ["main.c", "law.o"].map(path);
    let linked = Command::new("gcc").args(files).args(["-lm", "-o"]).arg(path("run")).output().unwrap();
    assert!(linked.status.success(), "{}", String::from_utf8_lossy(&linked.stderr));
    compare(&path("run"), &vectors);
}

#[test]
fn rust_compiles_without_the_standard_library_and_agrees() {
    let function = function(&OUTPUTS);
    let (code, vectors) = (function.code(Language::Rust).unwrap(), vectors(&function));
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    std::fs::write(path("law.rs"), &code).unwrap();
    let rustc = std::env::var_os("RUSTC").unwrap_or_else(|| "rustc".into());
    // The names of `libm` that the code may call; without the standard library they are only declared.
    let names = ["sin", "cos", "tan", "exp", "log", "sqrt", "tanh", "atan", "fabs"];
    let standard = |n: &str| match n {
        "log" => "ln".to_owned(),
        "fabs" => "abs".to_owned(),
        n => n.to_owned(),
    };
    let library = |body: &dyn Fn(&str) -> String| {
        let mut text = names.iter().fold(String::from("#[allow(dead_code)]\nmod libm {\n"), |mut text, n| {
            let _ = writeln!(text, "pub fn {n}(x: f64) -> f64 {{ {} }}", body(n));
            text
        });
        let _ = writeln!(text, "pub fn pow(x: f64, y: f64) -> f64 {{ {} }}\n}}", body("pow"));
        text
    };
    let bare =
        format!("#![no_std]\n{}{code}", library(&|n| if n == "pow" { "x + y".into() } else { "x".into() }));
    std::fs::write(path("bare.rs"), bare).unwrap();
    let compiled = Command::new(&rustc)
        .args(["--edition", "2024", "--crate-type", "lib", "-D", "warnings", "--emit", "metadata", "-o"])
        .arg(path("bare.rmeta"))
        .arg(path("bare.rs"))
        .output()
        .unwrap();
    assert!(compiled.status.success(), "{}\n{code}", String::from_utf8_lossy(&compiled.stderr));
    let whole = format!(
        "{}{code}\nconst IN: [([f64; 3], [f64; 1]); {}] = [\n{}];\n\
         fn main() {{\n for (x, r) in &IN {{\n  let out = law(x, r);\n  println!(\"{{}}\", out.map(|v| format!(\"{{v:?}}\")).join(\" \"));\n }}\n}}\n",
        library(&|n| if n == "pow" { "x.powf(y)".into() } else { format!("x.{}()", standard(n)) }),
        vectors.len(),
        vectors.iter().fold(String::new(), |mut text, v| {
            let a = &v.arguments;
            let _ = writeln!(text, "([{:?}, {:?}, {:?}], [{:?}]),", a[0], a[1], a[2], a[3]);
            text
        })
    );
    std::fs::write(path("main.rs"), whole).unwrap();
    let compiled = Command::new(&rustc)
        .args(["--edition", "2024", "-O", "-o"])
        .arg(path("run"))
        .arg(path("main.rs"))
        .output()
        .unwrap();
    assert!(compiled.status.success(), "{}", String::from_utf8_lossy(&compiled.stderr));
    compare(&path("run"), &vectors);
}

/// An argument that is not a number must not become a command, whichever operand it is.
#[test]
fn what_is_no_number_stays_none() {
    if Command::new("gcc").arg("--version").output().is_err() {
        println!("skipped: no C compiler here");
        return;
    }
    let outputs =
        ["min(q, 1)", "min(1, q)", "max(q, 1)", "max(1, q)", "saturate(q, 1)", "deadzone(q, 1)", "sign(q)"];
    let code = function(&outputs).code(Language::C99).unwrap();
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    let main = format!(
        "{code}\n#include <stdio.h>\nint main(void) {{\n double x[3] = {{NAN, 0.0, 0.0}}, r[1] = {{0.0}}, out[7];\n\
         law(x, r, out);\n for (int k = 0; k < 7; k++) printf(\"%d \", out[k] != out[k]);\n return 0;\n}}\n"
    );
    std::fs::write(path("main.c"), main).unwrap();
    let made = Command::new("gcc").arg(path("main.c")).args(["-lm", "-o"]).arg(path("run")).output().unwrap();
    assert!(made.status.success(), "{}", String::from_utf8_lossy(&made.stderr));
    let reported = Command::new(path("run")).output().unwrap().stdout;
    assert_eq!(String::from_utf8(reported).unwrap().trim(), "1 1 1 1 1 1 1");
}

#[test]
fn what_occurs_twice_is_computed_once() {
    let code = function(&["sin(q)*sin(q) + sin(q)"]).code(Language::C99).unwrap();
    assert_eq!(code.matches("sin(").count(), 1, "{code}");
    assert!(
        code.contains("const double t0 = sin(x[0]);") && code.contains("out[0] = t0 * t0 + t0;"),
        "{code}"
    );
    // Constants that nobody uses are not written; names that the languages have are.
    assert!(!code.contains("unused"), "{code}");
    let code = function(&["double*q"]).code(Language::Rust).unwrap();
    assert!(code.contains("let p_double: f64 = 1e-7; // double"), "{code}");
}

#[test]
fn what_cannot_be_written_is_refused() {
    let refused = |f: Function| f.code(Language::C99).unwrap_err();
    let error = refused(function(&["q + q''"]));
    assert!(error.to_string().contains("`q''`, which is neither"), "{error}");
    assert!(matches!(refused(function(&["delay(q, 0.1)"])), ExportError::Time { function: "delay", .. }));
    assert!(matches!(refused(function(&["step(q, 0.1)"])), ExportError::Time { function: "step", .. }));
    let named = |name: &str| refused(Function { name: name.into(), ..function(&["q"]) });
    for name in ["", "9x", "a b", "double", "fn", "t3", "größe", "out"] {
        assert_eq!(named(name), ExportError::Name { name: name.into() });
    }
    let mut twice = function(&["q"]);
    twice.constants.push(Constant::new("k", 1.0, ""));
    assert_eq!(refused(twice), ExportError::Twice { name: "k".into() });
    let mut infinite = function(&["q"]);
    infinite.constants.push(Constant::new("big", f64::INFINITY, ""));
    assert!(matches!(refused(infinite), ExportError::NotFinite { .. }));
    assert!(function(&["q"]).vectors(&[vec![1.0, 2.0]]).is_err());
    assert!(function(&["q"]).vectors(&[vec![1.0, f64::NAN, 0.0, 0.0]]).is_err());
}

/// A tank, x' = ±u − x + d, under a law that holds it: the first command after a start at rest is the held one, of a Kalman filter of two
/// sensors and of a chain whose gain is negative, in both languages; what is no number, or has no rest, is refused.
#[test]
fn an_observer_starts_at_a_machine_at_rest() {
    let group =
        |name: &str, member: &str| Group { name: name.into(), members: vec![Member::new(member, 0, "")] };
    let function = |name: &str, arguments: Vec<Group>, output: &str| Function {
        name: name.into(),
        summary: vec![],
        arguments,
        constants: vec![],
        outputs: vec![(String::new(), parse(output).unwrap().expr)],
    };
    let observer = |rate: &str, law: &str, measured: &[usize], form: ObserverForm| ObserverCode {
        summary: vec!["A tank.".into()],
        rate: function("plant_rate", vec![group("state", "x"), group("command", "u")], rate),
        law: function(
            "control_law",
            vec![group("state", "x"), group("disturbance", "d"), group("set_point", "r")],
            law,
        ),
        dt: 0.01,
        measured: measured.to_vec(),
        dead_zone: 0.1,
        substeps: 1,
        input_delay: (1, 0.004),
        form,
        rest: None,
    };
    let start = StartForm {
        point: vec![1.0, 1.0],
        sizes: vec![1.0, 1.0],
        matrix: vec![vec![0.0, 0.5, 0.5], vec![1.0, 0.5, 0.5]],
        most_steps: 50,
        last_step: 1e-10,
        close: 1e-6,
    };
    // A matrix that goes away from what is measured.
    let astray = StartForm { matrix: vec![vec![0.0, -0.5, -0.5], vec![1.0, 0.5, 0.5]], ..start.clone() };
    let chain = ChainForm {
        first: 0,
        a: vec![vec![0.0, 0.0], vec![0.0, 1.0]],
        before: vec![0.0, 0.0],
        now: vec![1.0, 0.0],
        input: vec![0.0, 0.0],
        gain: -1.0,
        weight: 1.0,
    };
    let (up, down) = (("u - x", "r - 2*(x - r) - d"), ("-u - x", "-r + 2*(x - r) - d"));
    let kalman = |start: &StartForm| ObserverForm::Kalman {
        gain: vec![vec![0.2, 0.2], vec![1.0, 1.0]],
        start: start.clone(),
    };
    let cases = [
        (up, &[0, 0][..], kalman(&start), "1 0.7 0 0 "),
        (up, &[0, 0], kalman(&astray), "0 0 0 0 "),
        (down, &[0], ObserverForm::Chains(vec![chain]), "1 0.7 0 0 "),
    ];
    for ((rate, law), measured, form, wanted) in cases {
        let code = observer(rate, law, measured, form);
        let m = measured.len();
        // (The code of a dead zone is the law's matter: 0.7 is held, of which 0.6 acts.)
        let law = Function {
            outputs: vec![(String::new(), parse(&format!("{law} + 0.1")).unwrap().expr)],
            ..code.law.clone()
        };
        let folder = tempfile::tempdir().unwrap();
        let path = |name: &str| folder.path().join(name);
        let run =
            |program: &str| String::from_utf8(Command::new(path(program)).output().unwrap().stdout).unwrap();
        let main = format!(
            "mod libm {{}}\n#[allow(unused_imports)]\nmod law {{ use super::libm; include!(\"law.rs\"); }}\n#[allow(unused_imports)]\n\
             mod observer {{ use super::libm; include!(\"observer.rs\"); }}\nuse observer::Observer;\nfn main() {{\n \
             match Observer::start_at(&[2.0; {m}], 0.7) {{\n  Some(mut o) => print!(\"1 {{:.3}} \", \
             (o.step(&[2.0; {m}], &[2.0], law::control_law) * 1e6).round() / 1e6),\n  None => print!(\"0 0 \"),\n }}\n \
             print!(\"{{}} \", u8::from(Observer::start_at(&[f64::NAN; {m}], 0.7).is_some()));\n \
             print!(\"{{}} \", u8::from(Observer::start_at(&[2.0; {m}], f64::INFINITY).is_some()));\n}}\n"
        );
        std::fs::write(path("law.rs"), law.code(Language::Rust).unwrap()).unwrap();
        std::fs::write(path("observer.rs"), code.code(Language::Rust).unwrap()).unwrap();
        std::fs::write(path("main.rs"), main.replace("{:.3}", "{}")).unwrap();
        let rustc = std::env::var_os("RUSTC").unwrap_or_else(|| "rustc".into());
        let made = Command::new(&rustc)
            .current_dir(folder.path())
            .args(["--edition", "2024", "-A", "dead_code", "-o", "run_rust", "main.rs"])
            .output()
            .unwrap();
        assert!(made.status.success(), "{}", String::from_utf8_lossy(&made.stderr));
        assert_eq!(run("run_rust"), wanted);
        if Command::new("gcc").arg("--version").output().is_err() {
            println!("skipped: no C compiler here");
            continue;
        }
        let main = "#include \"observer.c\"\n#include <math.h>\n#include <stdio.h>\nint main(void)\n{\n    static const double y[2] = {2.0, 2.0}, \
             none[2] = {NAN, 2.0}, r[1] = {2.0};\n    observer_memory m;\n    const int found = observer_start_at(&m, y, 0.7);\n    \
             printf(\"%d %g \", found, found ? observer_step(&m, y, r) : 0.0);\n    printf(\"%d \", observer_start_at(&m, none, 0.7));\n    \
             printf(\"%d \", observer_start_at(&m, y, INFINITY));\n    return 0;\n}\n";
        std::fs::write(path("law.c"), law.code(Language::C99).unwrap()).unwrap();
        std::fs::write(path("observer.c"), code.code(Language::C99).unwrap()).unwrap();
        std::fs::write(path("main.c"), main).unwrap();
        let strict = ["-std=c99", "-O2", "-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Werror"];
        let made = Command::new("gcc")
            .current_dir(folder.path())
            .args(strict)
            .args(["main.c", "law.c", "-lm", "-o", "run_c"])
            .output()
            .unwrap();
        assert!(made.status.success(), "{}", String::from_utf8_lossy(&made.stderr));
        assert_eq!(run("run_c"), wanted);
    }
}
