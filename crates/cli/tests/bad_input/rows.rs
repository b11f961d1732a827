//! The rows of the table of bad inputs.
#![allow(clippy::unwrap_used, reason = "helpers of tests panic like the tests themselves")]

use std::fmt::Write as _;
use std::fs;

use crate::common::Bench;
use crate::spring::{MODEL, recording};

/// A bad input. It begins in a folder with a good `model.toml` and a good `run.csv`.
pub(crate) struct Row {
    pub(crate) section: &'static str,
    /// In words.
    pub(crate) what: &'static str,
    /// What is put into the folder.
    pub(crate) make: fn(&Bench),
    /// The line of the shell.
    pub(crate) run: &'static str,
    pub(crate) code: i32,
    /// A folder that another process keeps meanwhile.
    pub(crate) held: Option<&'static str>,
}

impl Row {
    /// A refusal.
    const fn new(section: &'static str, what: &'static str, make: fn(&Bench), run: &'static str) -> Row {
        Row { section, what, make, run, code: 2, held: None }
    }
}

/// Every row, in the order of the page.
pub(crate) fn rows() -> Vec<Row> {
    [
        files(),
        foreign(),
        texts(),
        cells(),
        formats(),
        fits(),
        toml(),
        names(),
        equations(),
        own(),
        options(),
        designs(),
        places(),
    ]
    .into_iter()
    .flatten()
    .chain(limits())
    .collect()
}

const NOTHING: fn(&Bench) = |_| {};

/// The recording with its line `at` (the header is line 1) written anew.
fn line(at: usize, new: &str) -> String {
    let run = recording(60, 0.0);
    let lines: Vec<&str> =
        run.lines().enumerate().map(|(k, old)| if k + 1 == at { new } else { old }).collect();
    lines.join("\n") + "\n"
}

/// The model with one piece of its text written anew.
fn model(old: &str, new: &str) -> String {
    assert!(MODEL.contains(old), "{old}");
    MODEL.replace(old, new)
}

/// The recording with its cells written anew: row (0 is the first sample), time, f and x to a line.
fn rewritten(rows: usize, header: &str, row: impl Fn(usize, &str, &str, &str) -> String) -> String {
    let run = recording(rows, 0.0);
    let mut text = format!("{header}\n");
    for (k, old) in run.lines().skip(1).enumerate() {
        let cells: Vec<&str> = old.split(',').collect();
        writeln!(text, "{}", row(k, cells[0], cells[1], cells[2])).unwrap();
    }
    text
}

fn binary(bench: &Bench, name: &str, content: &[u8]) {
    fs::write(bench.path(name), content).unwrap();
}

fn files() -> Vec<Row> {
    const S: &str = "Files";
    vec![
        Row::new(S, "the recording is missing", NOTHING, "greybox check nowhere.csv"),
        Row::new(S, "the model is missing", NOTHING, "greybox check run.csv --model nowhere.toml"),
        Row::new(
            S,
            "a folder in the place of a recording",
            |b| fs::create_dir(b.path("runs")).unwrap(),
            "greybox simulate model.toml runs --out out.csv",
        ),
        Row::new(
            S,
            "a folder in the place of the model",
            |b| fs::create_dir(b.path("runs")).unwrap(),
            "greybox diagnose runs run.csv --out out",
        ),
        Row::new(S, "a device in the place of a recording", NOTHING, "greybox check /dev/zero"),
        Row::new(S, "a device in the place of the model", NOTHING, "greybox check run.csv --model /dev/zero"),
        Row::new(S, "a path that goes through a file", NOTHING, "greybox check run.csv/run.csv"),
        Row::new(S, "the recording is empty", |b| b.write("empty.csv", ""), "greybox check empty.csv"),
        Row::new(
            S,
            "the model is empty",
            |b| b.write("empty.toml", "\n"),
            "greybox check run.csv --model empty.toml",
        ),
        Row::new(
            S,
            "a folder without recordings",
            |b| {
                fs::create_dir(b.path("runs")).unwrap();
                b.write("runs/notes.txt", "none yet");
            },
            "greybox diagnose model.toml runs --out out",
        ),
        Row::new(
            S,
            "a folder beside other recordings",
            |b| {
                fs::create_dir(b.path("runs")).unwrap();
                b.write("runs/more.csv", &recording(60, 0.0));
            },
            "greybox diagnose model.toml run.csv runs --out out",
        ),
        Row::new(S, "a model in the place of a recording", NOTHING, "greybox check model.toml"),
        Row::new(
            S,
            "a recording in the place of the model",
            NOTHING,
            "greybox diagnose run.csv model.toml --out out",
        ),
        Row::new(
            S,
            "a recording that is named twice",
            NOTHING,
            "greybox diagnose model.toml run.csv ./run.csv --out out",
        ),
        Row::new(
            S,
            "a recording both to learn from and held out",
            NOTHING,
            "greybox diagnose model.toml run.csv --holdout run.csv --out out",
        ),
        Row::new(
            S,
            "a file that is no report",
            |b| b.write("report.json", "{\"verdict\": 3}"),
            "greybox compare report.json report.json",
        ),
    ]
}

fn foreign() -> Vec<Row> {
    const S: &str = "Files of other tools";
    const ZIP: &[u8] = b"PK\x03\x04\x14\0\x06\0\x08\0\0\0!\0modelDescription.xml";
    const URDF: &str = "<?xml version=\"1.0\"?>\n<robot name=\"arm\">\n  <link name=\"upper\"/>\n</robot>\n";
    const MODELICA: &str = "model Spring\n  Real x;\nequation\n  der(x) = -x;\nend Spring;\n";
    let model = |what, make, run| Row::new(S, what, make, run);
    vec![
        model("an FMU", |b| binary(b, "arm.fmu", ZIP), "greybox diagnose arm.fmu run.csv --out out"),
        model(
            "a Simulink model",
            |b| binary(b, "arm.slx", ZIP),
            "greybox diagnose arm.slx run.csv --out out",
        ),
        model(
            "a Simulink model of old",
            |b| b.write("arm.mdl", "Model {\n  Name \"arm\"\n}\n"),
            "greybox simulate arm.mdl run.csv --out out.csv",
        ),
        model(
            "a robot description",
            |b| b.write("arm.urdf", URDF),
            "greybox calibrate arm.urdf run.csv --out out",
        ),
        model(
            "a robot description that is called XML",
            |b| b.write("arm.xml", URDF),
            "greybox check run.csv --model arm.xml",
        ),
        model(
            "a simulated world",
            |b| b.write("world.sdf", "<sdf version=\"1.7\"/>\n"),
            "greybox check run.csv --model world.sdf",
        ),
        model(
            "a MuJoCo model",
            |b| b.write("arm.xml", "<mujoco model=\"arm\">\n</mujoco>\n"),
            "greybox check run.csv --model arm.xml",
        ),
        model("an XML file", |b| b.write("arm.xml", "<arm/>\n"), "greybox check run.csv --model arm.xml"),
        model(
            "a Python program",
            |b| b.write("arm.py", "def rate(t, x):\n    return [x[1], -x[0]]\n"),
            "greybox diagnose arm.py run.csv --out out",
        ),
        model(
            "a notebook",
            |b| b.write("arm.ipynb", "{\"cells\": []}\n"),
            "greybox diagnose arm.ipynb run.csv --out out",
        ),
        model(
            "a MATLAB program",
            |b| b.write("arm.m", "[t, x] = ode45(@rate, [0 1], [0 0]);\n"),
            "greybox diagnose arm.m run.csv --out out",
        ),
        model("a Modelica model", |b| b.write("arm.mo", MODELICA), "greybox export arm.mo --to python"),
        model(
            "an archive that is called a model",
            |b| binary(b, "arm.toml", ZIP),
            "greybox check run.csv --model arm.toml",
        ),
        model(
            "a MAT-file in the place of the model",
            |b| binary(b, "run.mat", b"MATLAB 5.0 MAT-file\0\0"),
            "greybox diagnose run.mat run.csv --out out",
        ),
        model(
            "a robot description in the place of a recording",
            |b| b.write("arm.urdf", URDF),
            "greybox check arm.urdf",
        ),
        model(
            "a Python program in the place of a recording",
            |b| b.write("arm.py", "print(1)\n"),
            "greybox diagnose model.toml arm.py --out out",
        ),
        model("an FMU in the place of a recording", |b| binary(b, "arm.fmu", ZIP), "greybox check arm.fmu"),
        model(
            "a spreadsheet in the place of a recording",
            |b| binary(b, "run.xlsx", ZIP),
            "greybox check run.xlsx",
        ),
    ]
}

fn texts() -> Vec<Row> {
    const S: &str = "Recordings: the text and its header";
    vec![
        Row::new(
            S,
            "a picture that is called a recording",
            |b| binary(b, "run.png.csv", b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR\0\0\x02\x80\0\0\x01\xe0\x08\x02"),
            "greybox check run.png.csv",
        ),
        Row::new(
            S,
            "a spreadsheet that is called a recording",
            |b| binary(b, "book.csv", b"PK\x03\x04\x14\0\x06\0\x08\0\0\0!\0xl/workbook.xml"),
            "greybox check book.csv",
        ),
        Row::new(
            S,
            "UTF-16, as some loggers write",
            |b| {
                let text: Vec<u8> = recording(60, 0.0).encode_utf16().flat_map(u16::to_le_bytes).collect();
                binary(b, "wide.csv", &[b"\xff\xfe" as &[u8], &text].concat());
            },
            "greybox check wide.csv",
        ),
        Row::new(
            S,
            "Latin-1: the degree sign is no UTF-8",
            |b| {
                let run = line(1, "t,f [N],x [DEG]");
                let (head, tail) = run.split_once("DEG").unwrap();
                binary(b, "latin.csv", &[head.as_bytes(), b"\xb0", tail.as_bytes()].concat());
            },
            "greybox check latin.csv",
        ),
        Row::new(
            S,
            "zero bytes where a disk was full",
            |b| {
                let run = recording(60, 0.0);
                binary(b, "holes.csv", &[&run.as_bytes()[..500], &[0u8; 64] as &[u8]].concat());
            },
            "greybox check holes.csv",
        ),
        Row::new(
            S,
            "semicolons between the columns",
            |b| b.write("semi.csv", &recording(60, 0.0).replace(',', ";")),
            "greybox check semi.csv",
        ),
        Row::new(
            S,
            "tabs between the columns",
            |b| b.write("tabs.csv", &recording(60, 0.0).replace(',', "\t")),
            "greybox check tabs.csv",
        ),
        Row::new(
            S,
            "decimal commas in quotes",
            |b| b.write("comma.csv", &line(3, "\"0,01\",\"0,07\",\"-0,1\"")),
            "greybox check comma.csv",
        ),
        Row::new(
            S,
            "decimal commas without quotes",
            |b| b.write("comma.csv", &line(3, "0,01,0,07,-0,1")),
            "greybox check comma.csv",
        ),
        Row::new(
            S,
            "no header",
            |b| b.write("bare.csv", recording(60, 0.0).split_once('\n').unwrap().1),
            "greybox check bare.csv",
        ),
        Row::new(
            S,
            "nothing below the header",
            |b| b.write("head.csv", "t,f [N],x [mm]\n"),
            "greybox check head.csv",
        ),
        Row::new(
            S,
            "the first column is not the time",
            |b| b.write("order.csv", &line(1, "x [mm],f [N],t")),
            "greybox check order.csv",
        ),
        Row::new(
            S,
            "a time in hours",
            |b| b.write("hours.csv", &line(1, "t [h],f [N],x [mm]")),
            "greybox check hours.csv",
        ),
        Row::new(
            S,
            "a time and nothing else",
            |b| b.write("alone.csv", &rewritten(60, "t", |_, t, _, _| t.to_owned())),
            "greybox check alone.csv",
        ),
        Row::new(
            S,
            "a column without a name",
            |b| b.write("blank.csv", &line(1, "t,,x [mm]")),
            "greybox check blank.csv",
        ),
        Row::new(
            S,
            "a bracket that does not close",
            |b| b.write("open.csv", &line(1, "t,f [N,x [mm]")),
            "greybox check open.csv",
        ),
        Row::new(
            S,
            "two columns of one name",
            |b| b.write("twins.csv", &line(1, "t,x [N],x [mm]")),
            "greybox check twins.csv",
        ),
    ]
}

fn cells() -> Vec<Row> {
    const S: &str = "Recordings: rows and cells";
    vec![
        Row::new(
            S,
            "a row with a cell too few",
            |b| b.write("short.csv", &line(7, "0.05,0.3")),
            "greybox check short.csv",
        ),
        Row::new(
            S,
            "a row with a cell too many",
            |b| b.write("long.csv", &line(7, "0.05,0.3,1.0,2.0")),
            "greybox check long.csv",
        ),
        Row::new(
            S,
            "a quotation mark that does not close",
            |b| b.write("quote.csv", &line(7, "0.05,\"0.3,1.0")),
            "greybox check quote.csv",
        ),
        Row::new(
            S,
            "a word in a cell",
            |b| b.write("word.csv", &line(7, "0.05,n/a,1.0")),
            "greybox check word.csv",
        ),
        Row::new(
            S,
            "a number with its unit",
            |b| b.write("unit.csv", &line(7, "0.05,0.3,1.0 mm")),
            "greybox check unit.csv",
        ),
        Row::new(
            S,
            "NaN in a cell",
            |b| b.write("nan.csv", &line(7, "0.05,0.3,NaN")),
            "greybox check nan.csv",
        ),
        Row::new(
            S,
            "an infinity in a cell",
            |b| b.write("inf.csv", &line(7, "0.05,-inf,1.0")),
            "greybox check inf.csv",
        ),
        Row::new(
            S,
            "a number beyond all numbers",
            |b| b.write("huge.csv", &line(7, "0.05,0.3,1e999")),
            "greybox check huge.csv",
        ),
        Row::new(
            S,
            "a value that no computation survives",
            |b| b.write("huge.csv", &line(7, "0.05,0.3,1e200")),
            "greybox check huge.csv",
        ),
        Row::new(
            S,
            "a row without its time",
            |b| b.write("when.csv", &line(7, ",0.3,1.0")),
            "greybox check when.csv",
        ),
        Row::new(
            S,
            "time that goes back",
            |b| b.write("back.csv", &line(7, "0.005,0.3,1.0")),
            "greybox check back.csv",
        ),
        Row::new(
            S,
            "time that stands still",
            |b| b.write("still.csv", &line(7, "0.04,0.3,1.0")),
            "greybox check still.csv",
        ),
        Row::new(
            S,
            "a clock that starts again",
            |b| {
                let run = recording(60, 0.0);
                b.write("again.csv", &format!("{run}{}", run.split_once('\n').unwrap().1));
            },
            "greybox check again.csv",
        ),
        Row::new(
            S,
            "sampling steps of 1e-200 s",
            |b| b.write("fast.csv", &rewritten(60, "t,f,x", |k, _, f, x| format!("{k}e-200,{f},{x}"))),
            "greybox check fast.csv",
        ),
        Row::new(S, "too few rows", |b| b.write("few.csv", &recording(5, 0.0)), "greybox check few.csv"),
        Row::new(
            S,
            "gaps everywhere",
            |b| {
                let time = |k: usize| k as f64 * 0.01 + (k / 4) as f64 * 100.0;
                b.write("gaps.csv", &rewritten(60, "t,f,x", |k, _, f, x| format!("{},{f},{x}", time(k))));
            },
            "greybox check gaps.csv",
        ),
    ]
}

/// The head of a MAT-file with this version and mark of the byte order.
fn mat(version: &[u8; 2], order: &[u8; 2]) -> Vec<u8> {
    let mut bytes = b"MATLAB 5.0 MAT-file".to_vec();
    bytes.resize(124, b' ');
    bytes.extend(version);
    bytes.extend(order);
    bytes
}

fn formats() -> Vec<Row> {
    const S: &str = "Recordings in other formats";
    let mut rows = Vec::new();
    if cfg!(feature = "mat") {
        rows.extend([
            Row::new(
                S,
                "a text that is called a MAT-file",
                |b| b.write("run.mat", &recording(60, 0.0)),
                "greybox check run.mat",
            ),
            Row::new(
                S,
                "a MAT-file of version 7.3, which is HDF5",
                |b| {
                    let mut bytes = b"MATLAB 7.3 MAT-file".to_vec();
                    bytes.resize(124, b' ');
                    bytes.extend(b"\x00\x02IM");
                    bytes.resize(512, 0);
                    bytes.extend(b"\x89HDF\r\n\x1a\n");
                    binary(b, "run.mat", &bytes);
                },
                "greybox check run.mat",
            ),
            Row::new(
                S,
                "a MAT-file that ends in its head",
                |b| binary(b, "run.mat", &mat(b"\x00\x01", b"IM")[..60]),
                "greybox check run.mat",
            ),
            Row::new(
                S,
                "a MAT-file whose variable claims more than there is",
                |b| {
                    let mut bytes = mat(b"\x00\x01", b"IM");
                    bytes.extend(14u32.to_le_bytes());
                    bytes.extend(4_000_000_000u32.to_le_bytes());
                    bytes.extend([0; 24]);
                    binary(b, "run.mat", &bytes);
                },
                "greybox check run.mat",
            ),
            Row::new(
                S,
                "a MAT-file that holds nothing",
                |b| binary(b, "run.mat", &mat(b"\x00\x01", b"IM")),
                "greybox check run.mat",
            ),
        ]);
    }
    rows.push(match cfg!(feature = "mcap") {
        true => Row::new(
            S,
            "an MCAP log that was cut off",
            |b| binary(b, "run.mcap", b"\x89MCAP0\r\n\x01"),
            "greybox check run.mcap",
        ),
        false => Row::new(
            S,
            "an MCAP log, which this build does not read",
            |b| binary(b, "run.mcap", b"\x89MCAP0\r\n\x01"),
            "greybox check run.mcap",
        ),
    });
    rows.push(match cfg!(feature = "parquet") {
        true => Row::new(
            S,
            "a Parquet file that was cut off",
            |b| binary(b, "run.parquet", b"PAR1\x15\x04\x15"),
            "greybox check run.parquet",
        ),
        false => Row::new(
            S,
            "a Parquet file, which this build does not read",
            |b| binary(b, "run.parquet", b"PAR1\x15\x04\x15"),
            "greybox check run.parquet",
        ),
    });
    rows.push(Row::new(
        S,
        "`--block` with a file that is no CSV",
        |b| binary(b, "run.mat", &mat(b"\x00\x01", b"IM")),
        "greybox identify run.mat --states x --inputs f --block 1000 --out out",
    ));
    rows
}

fn fits() -> Vec<Row> {
    const S: &str = "Recordings that do not fit the model";
    vec![
        Row::new(
            S,
            "a channel that the model needs is not there",
            |b| b.write("other.csv", &line(1, "t,f [N],y [mm]")),
            "greybox diagnose model.toml other.csv --out out",
        ),
        Row::new(
            S,
            "a channel whose unit measures something else",
            |b| b.write("other.csv", &line(1, "t,f [N],x [deg]")),
            "greybox diagnose model.toml other.csv --out out",
        ),
        Row::new(
            S,
            "a channel whose unit is unknown",
            |b| b.write("other.csv", &line(1, "t,f [N],x [furlong]")),
            "greybox diagnose model.toml other.csv --out out",
        ),
        Row::new(
            S,
            "no channel moves",
            |b| b.write("flat.csv", &rewritten(200, "t,f [N],x [mm]", |_, t, f, _| format!("{t},{f},3"))),
            "greybox diagnose model.toml flat.csv --out out",
        ),
        Row::new(
            S,
            "a channel without one sample",
            |b| b.write("void.csv", &rewritten(200, "t,f [N],x [mm]", |_, t, f, _| format!("{t},{f},"))),
            "greybox diagnose model.toml void.csv --out out",
        ),
        Row::new(
            S,
            "an input without one sample",
            |b| b.write("void.csv", &rewritten(200, "t,f [N],x [mm]", |_, t, _, x| format!("{t},,{x}"))),
            "greybox diagnose model.toml void.csv --out out",
        ),
        Row::new(
            S,
            "too short for the model",
            |b| b.write("brief.csv", &recording(20, 0.0)),
            "greybox diagnose model.toml brief.csv --out out",
        ),
        Row::new(
            S,
            "held out is another machine",
            |b| b.write("other.csv", &line(1, "t,v [V],x [mm]")),
            "greybox calibrate model.toml run.csv --holdout other.csv --out out",
        ),
        Row::new(
            S,
            "`--map` names a channel that is not there",
            |b| b.write("raw.csv", &line(1, "t,force,sensor_3")),
            "greybox check raw.csv --map x=sensor3",
        ),
        Row::new(
            S,
            "`--channels` names a channel that is not there",
            |b| b.write("raw.csv", &line(1, "t,force,sensor_3")),
            "greybox check raw.csv --channels sensor3",
        ),
        Row::new(
            S,
            "`--map` to a name that is taken",
            |b| b.write("raw.csv", &line(1, "t,force,sensor_3")),
            "greybox check raw.csv --map force=sensor_3",
        ),
        Row::new(S, "`--map` against the unit of the file", NOTHING, "greybox check run.csv --map 'x=x [m]'"),
        Row::new(
            S,
            "`--map` with a unit that is no unit",
            NOTHING,
            "greybox check run.csv --map 'x=x [N//m]'",
        ),
        Row::new(
            S,
            "`--map` with an unknown unit",
            |b| b.write("raw.csv", &line(1, "t,f,x")),
            "greybox diagnose model.toml raw.csv --map 'x=x [furlong]' --out out",
        ),
        Row::new(S, "`--map` without a name", NOTHING, "greybox check run.csv --map x"),
        Row::new(
            S,
            "`identify` for a state that is not measured",
            NOTHING,
            "greybox identify run.csv --states y --inputs f --out out",
        ),
        Row::new(
            S,
            "`identify` from nothing that moves",
            |b| b.write("flat.csv", &rewritten(200, "t,f [N],x [mm]", |_, t, f, _| format!("{t},{f},3"))),
            "greybox identify flat.csv --states x --inputs f --order 2 --out out",
        ),
        Row::new(
            S,
            "every recording of a folder is bad",
            |b| {
                fs::create_dir(b.path("runs")).unwrap();
                b.write("runs/friday.csv", &line(1, "t,f [N],y [mm]"));
                b.write("runs/monday.csv", &line(7, "0.05,?,1.0"));
            },
            "greybox diagnose model.toml runs --out out",
        ),
    ]
}

const CHECK: &str = "greybox check run.csv --model bad.toml";

/// A row whose model is the good one with a piece of its text written anew.
macro_rules! altered {
    ($section:expr, $what:expr, $old:expr, $new:expr) => {
        Row::new($section, $what, |b| b.write("bad.toml", &model($old, $new)), CHECK)
    };
}

fn toml() -> Vec<Row> {
    const S: &str = "Models: the file";
    vec![
        altered!(S, "an equation without quotes", "\"m*x'' + b*x' + k*x = f\"", "m*x'' + b*x' + k*x = f"),
        altered!(
            S,
            "a table that stands twice",
            "[parameters]",
            "[states]\ny = { unit = \"m\" }\n[parameters]"
        ),
        altered!(S, "an unknown table", "[parameters]", "[parameter]"),
        altered!(S, "an unknown key", "value = 30.0", "vlaue = 30.0"),
        altered!(S, "no states", "x = { unit = \"m\" } # measured in mm", ""),
        altered!(S, "no table of states", "[states]\nx = { unit = \"m\" } # measured in mm", ""),
        altered!(S, "no equations", "body = \"m*x'' + b*x' + k*x = f\"", ""),
        altered!(S, "a parameter without a value", "value = 30.0, ", ""),
        altered!(S, "a value in quotes", "value = 30.0", "value = \"30\""),
        altered!(S, "a value that is no number", "value = 30.0", "value = nan"),
        altered!(S, "an infinite value", "value = 30.0", "value = inf"),
        altered!(
            S,
            "a value that is an integer of more than 64 bits",
            "value = 30.0",
            "value = 30000000000000000000"
        ),
        altered!(
            S,
            "a value that its unit makes infinite",
            "value = 30.0, unit = \"N/m\"",
            "value = 1e308, unit = \"kN/mm\""
        ),
        altered!(S, "a negative uncertainty", "value = 30.0", "std = -1, value = 30.0"),
        altered!(S, "a name that is an operator", "b = { value", "\"b+\" = { value"),
        altered!(S, "a name that the language has", "b = { value", "sin = { value"),
        altered!(S, "a name that stands for two things", "b = { value", "x = { value"),
        altered!(S, "an unknown hold", "f = { unit = \"N\" }", "f = { unit = \"N\", hold = \"cubic\" }"),
        altered!(
            S,
            "an initial state of three numbers",
            "unit = \"m\" }",
            "unit = \"m\", initial = [0, 0, 0] }"
        ),
        Row::new(
            S,
            "a model in Latin-1",
            |b| binary(b, "bad.toml", b"name = \"Feder\"\n# D\xe4mpfung\n"),
            CHECK,
        ),
        Row::new(
            S,
            "more parameters than can be computed with",
            |b| {
                let many: String = (0..600).map(|k| format!("p{k} = {{ value = 1 }}\n")).collect();
                b.write("bad.toml", &model("[equations]", &format!("{many}[equations]")));
            },
            CHECK,
        ),
    ]
}

fn names() -> Vec<Row> {
    const S: &str = "Models: names and units";
    vec![
        altered!(S, "an unknown name in an equation", "k*x = f", "kk*x = f"),
        altered!(S, "an unknown function", "k*x = f", "k*sinn(x) = f"),
        altered!(S, "a function without its argument", "k*x = f", "k*sin() = f"),
        altered!(S, "a function with an argument too many", "k*x = f", "k*x*sin(1, 2) = f"),
        altered!(S, "an unknown unit", "unit = \"N/m\"", "unit = \"N/furlong\""),
        altered!(S, "a unit that is no unit", "unit = \"N/m\"", "unit = \"N//m\""),
        altered!(S, "a built-in unit declared again", "[inputs]", "[units]\nmm = \"2 m\"\n\n[inputs]"),
        altered!(S, "a declared unit with a digit", "[inputs]", "[units]\nenc12 = \"2 rad\"\n\n[inputs]"),
        altered!(S, "a multiple of an unknown unit", "[inputs]", "[units]\nrod = \"16.5 foot\"\n\n[inputs]"),
        altered!(S, "a negative multiple", "[inputs]", "[units]\nrod = \"-5 m\"\n\n[inputs]"),
        altered!(
            S,
            "units that define each other",
            "[inputs]",
            "[units]\nrod = \"2 perch\"\nperch = \"0.5 rod\"\n\n[inputs]"
        ),
        altered!(
            S,
            "a fifth dimension of its own",
            "[inputs]",
            "[units]\npa = \"own\"\npb = \"own\"\npc = \"own\"\npd = \"own\"\npe = \"own\"\n\n[inputs]"
        ),
        altered!(
            S,
            "a list in the place of a definition",
            "[inputs]",
            "[units]\nrod = [5, \"m\"]\n\n[inputs]"
        ),
        altered!(S, "terms whose units differ", "b*x' + k*x", "b*x + k*x"),
        altered!(S, "the sine of a length", "k*x = f", "k*sin(x) = f"),
        altered!(S, "a length as an exponent", "k*x = f", "k*x^x = f"),
        altered!(
            S,
            "a measurement of what is not there",
            "[equations]",
            "[measurements]\nspeed = \"y'\"\n\n[equations]"
        ),
        altered!(
            S,
            "a state that the equations do not have",
            "[parameters]",
            "y = { unit = \"m\" }\n\n[parameters]"
        ),
    ]
}

fn equations() -> Vec<Row> {
    const S: &str = "Models: equations";
    vec![
        altered!(S, "a bracket of an equation that does not close", "k*x = f", "k*(x = f"),
        altered!(S, "an equation without an equals sign", "k*x = f", "k*x - f"),
        altered!(S, "an equation with two of them", "k*x = f", "k*x = f = 0"),
        altered!(S, "an operator without its right side", "k*x = f", "k* = f"),
        altered!(S, "a character of no meaning", "k*x = f", "k*x $ = f"),
        altered!(S, "an empty equation", "m*x'' + b*x' + k*x = f", ""),
        altered!(S, "a derivative of a parameter", "k*x = f", "k'*x = f"),
        altered!(S, "a derivative of an input", "k*x = f", "k*x = f + b*f'"),
        altered!(S, "a second derivative of an input", "k*x = f", "k*x = f + m*f''"),
        altered!(
            S,
            "a derivative of an input that is kept between its samples",
            "f = { unit = \"N\" }",
            "f = { unit = \"N\", hold = \"zero\" }\ndf = { unit = \"N/s\", channel = \"f'\" }"
        ),
        altered!(
            S,
            "a derivative in the unit of what it is the derivative of",
            "f = { unit = \"N\" }",
            "f = { unit = \"N\" }\ndf = { unit = \"N\", channel = \"f'\" }"
        ),
        altered!(
            S,
            "a second derivative of a channel",
            "f = { unit = \"N\" }",
            "f = { unit = \"N\" }\nddf = { unit = \"N/s^2\", channel = \"f''\" }"
        ),
        altered!(S, "more equations than states", "body =", "more = \"x' = 0\"\nbody ="),
        altered!(S, "an equation without a derivative", "m*x'' + b*x' + k*x = f", "k*x = f"),
        Row::new(
            S,
            "states that each state the other: a cycle",
            |b| {
                let text = model("x = { unit = \"m\" }", "x = { unit = \"m\" }\ny = { unit = \"m\" }");
                b.write(
                    "two.csv",
                    &rewritten(200, "t,f [N],x [mm],y [mm]", |_, t, f, x| format!("{t},{f},{x},{f}")),
                );
                b.write(
                    "bad.toml",
                    &text
                        .replace("body = \"m*x'' + b*x' + k*x = f\"", "one = \"x' = y'\"\ntwo = \"y' = x'\""),
                );
            },
            "greybox diagnose bad.toml two.csv --out out",
        ),
        altered!(S, "a highest derivative that cancels", "m*x'' + b*x'", "m*x'' - m*x'' + b*x' - b*x'"),
        altered!(S, "a highest derivative under a root", "m*x''", "m*abs(x'')"),
        altered!(S, "a delay of no time", "k*x = f", "k*delay(x) = f"),
        altered!(S, "a delay that is negative", "k*x = f", "k*delay(x, -1) = f"),
        Row::new(
            S,
            "ten thousand brackets",
            |b| {
                let deep = format!("{}x{}", "(".repeat(10_000), ")".repeat(10_000));
                b.write("bad.toml", &model("k*x = f", &format!("k*{deep} = f")));
            },
            CHECK,
        ),
        Row::new(
            S,
            "a mass of zero",
            |b| b.write("bad.toml", &model("m = { value = 1.0", "m = { value = 0.0")),
            "greybox diagnose bad.toml run.csv --out out",
        ),
        Row::new(
            S,
            "a simulation that diverges whatever its parameters",
            |b| {
                let text = model("m = {", "v = { value = 1e-9, unit = \"m/s\", fixed = true }\nm = {");
                b.write("bad.toml", &text.replace("b*x'", "b*x'*(1 - exp((x'/v)^2))"));
            },
            "greybox diagnose bad.toml run.csv --out out",
        ),
        Row::new(
            S,
            "nothing to calibrate",
            |b| {
                let text = model("value = 0.5", "fixed = true, value = 0.5");
                b.write("bad.toml", &text.replace("value = 30.0", "fixed = true, value = 30.0"));
            },
            "greybox calibrate bad.toml run.csv --out out",
        ),
    ]
}

fn own() -> Vec<Row> {
    const S: &str = "Mechanisms of your own";
    const RUN: &str = "greybox mechanisms --mechanisms mine";
    fn mine(bench: &Bench, text: &str) {
        fs::create_dir(bench.path("mine")).unwrap();
        bench.write("mine/belt.toml", text);
    }
    vec![
        Row::new(S, "no such folder of mechanisms", NOTHING, RUN),
        Row::new(S, "a folder without mechanisms", |b| fs::create_dir(b.path("mine")).unwrap(), RUN),
        Row::new(
            S,
            "a file in the place of the folder",
            NOTHING,
            "greybox mechanisms --mechanisms model.toml",
        ),
        Row::new(S, "a mechanism that is a model", |b| mine(b, MODEL), RUN),
        Row::new(S, "a mechanism that is no TOML", |b| mine(b, "kind = belt\n"), RUN),
    ]
}

fn options() -> Vec<Row> {
    const S: &str = "Commands and options";
    let all = |what, run| Row::new(S, what, NOTHING, run);
    vec![
        all("no command", "greybox"),
        all("an unknown command", "greybox diagnos model.toml run.csv"),
        all("an unknown option", "greybox diagnose model.toml run.csv --out out --sed 1"),
        all("no recording", "greybox diagnose model.toml --out out"),
        all("no place for the results", "greybox diagnose model.toml run.csv"),
        all("a seed that is negative", "greybox diagnose model.toml run.csv --out out --seed -1"),
        all("a seed in words", "greybox diagnose model.toml run.csv --out out --seed one"),
        all("work that is negative", "greybox diagnose model.toml run.csv --out out --work -1"),
        all("work without a number", "greybox diagnose model.toml run.csv --out out --work"),
        all("an option given twice", "greybox diagnose model.toml run.csv --out out --out there"),
        all(
            "a watch of two brokers",
            "greybox watch model.toml --from mqtt://one/samples --from mqtt://other/samples",
        ),
        all("an address of a broker without a topic", "greybox watch model.toml --from mqtt://broker"),
        all(
            "a certificate without TLS",
            "greybox watch model.toml --from mqtt://broker/samples --cert client.pem",
        ),
        all(
            "a key without its certificate",
            "greybox watch model.toml --from mqtts://broker/samples --key client.key",
        ),
        all("names of columns without a time", "greybox watch model.toml --columns sec,nanosec,x"),
        all("a column named twice", "greybox watch model.toml --columns t,x,x"),
        all("a time in minutes among the names of columns", "greybox watch model.toml --columns 't [min],x'"),
        all(
            "objects where columns are named",
            "echo '{\"t\": 0}' | greybox watch model.toml --columns t,f,x",
        ),
        all("an input of `--inputs` that is not there", "greybox check run.csv --inputs g"),
        all(
            "two kinds of monomials",
            "greybox identify run.csv --states x --inputs f --library tensor,total --out out",
        ),
        all(
            "an unknown part of the library",
            "greybox identify run.csv --states x --inputs f --library all --out out",
        ),
        all("an order of zero", "greybox identify run.csv --states x --inputs f --order 0 --out out"),
        all(
            "an order of a thousand",
            "greybox identify run.csv --states x --inputs f --order 1000 --out out",
        ),
        all("a third derivative", "greybox identify run.csv --states x --inputs f --derivatives 3 --out out"),
        all(
            "no resampled data sets",
            "greybox identify run.csv --states x --inputs f --replicates 0 --out out",
        ),
        all("blocks of ten rows", "greybox identify run.csv --states x --inputs f --block 10 --out out"),
        all("a gain without a delay", "greybox identify run.csv --states x --inputs f --gain 2 --out out"),
        all(
            "a longest delay that is negative",
            "greybox identify run.csv --states x --inputs f --delay x --longest -1 --out out",
        ),
        all(
            "a longest delay longer than the recording",
            "greybox identify run.csv --states x --inputs f --delay x --longest 100 --out out",
        ),
        all(
            "a dead time of what is no input",
            "greybox identify run.csv --states x --inputs f --dead-time g --out out",
        ),
        all(
            "a dead time below zero",
            "greybox identify run.csv --states x --inputs f --dead-time f=-1 --out out",
        ),
        all(
            "a dead time longer than the recording",
            "greybox identify run.csv --states x --inputs f --dead-time f=100 --out out",
        ),
        all(
            "a dead time beside a delayed feedback",
            "greybox identify run.csv --states x --inputs f --dead-time f --delay x --out out",
        ),
        all("a state that is an input too", "greybox identify run.csv --states x --inputs x --out out"),
        all("a state named twice", "greybox identify run.csv --states x,x --inputs f --out out"),
        all(
            "a delayed state that is none",
            "greybox identify run.csv --states x --inputs f --delay y --out out",
        ),
        all(
            "a term of unknown names",
            "greybox identify run.csv --states x --inputs f --term 'y*abs(x)' --out out",
        ),
        all("a term that is none", "greybox identify run.csv --states x --inputs f --term 'x +' --out out"),
        all("an unknown language", "greybox export model.toml --to fortran"),
        all("an unknown template", "greybox new robot"),
    ]
}

/// A reference of two seconds, in steps of 0.05 s.
fn moves(header: &str, value: impl Fn(u32) -> Option<f64>) -> String {
    let mut text = format!("t [s],{header}\n");
    for k in 0..=40 {
        let cell = value(k).map_or_else(String::new, |v| v.to_string());
        writeln!(text, "{},{cell}", 0.05 * f64::from(k)).unwrap();
    }
    text
}

fn designs() -> Vec<Row> {
    const S: &str = "Controllers";
    let all = |what, run| Row::new(S, what, NOTHING, run);
    let with = |what: &'static str, make: fn(&Bench), run: &'static str| Row::new(S, what, make, run);
    vec![
        all("a state to track that is none", "greybox control model.toml --track y --out out"),
        all("an input to command that is none", "greybox control model.toml --input g --out out"),
        all("a size without a number", "greybox control model.toml --size x --out out"),
        all("a size of zero", "greybox control model.toml --size x=0 --out out"),
        all("a limit that is negative", "greybox control model.toml --limit -1 --out out"),
        all("a limit that is no number", "greybox control model.toml --limit NaN --out out"),
        all("a sample time of zero", "greybox control model.toml --dt 0 --out out"),
        all("an odd degree", "greybox control model.toml --method hjb --degree 3 --out out"),
        all("limits in a cost that knows none", "greybox control model.toml --limit 1 --bounded --out out"),
        all("a bounded law without limits", "greybox control model.toml --method hjb --bounded --out out"),
        all("a pole that is unstable", "greybox control model.toml --method smc --lambda -10 --out out"),
        all("a set point at infinity", "greybox control model.toml --to inf --out out"),
        all("an observer's number without an observer", "greybox control model.toml --noise x=1 --out out"),
        all(
            "a sensor of what is not measured",
            "greybox control model.toml --feedback output --noise y=0.1 --out out",
        ),
        all(
            "a disturbance of zero",
            "greybox control model.toml --feedback output --disturbance 0 --out out",
        ),
        all(
            "a bandwidth below zero",
            "greybox control model.toml --feedback output --observer eso --bandwidth -3 --out out",
        ),
        all("a reference that is missing", "greybox control model.toml --reference move.csv --out out"),
        with(
            "a reference of something else",
            |bench| bench.write("move.csv", &moves("y [m]", |k| Some(0.05 * f64::from(k)))),
            "greybox control model.toml --reference move.csv --out out",
        ),
        with(
            "a reference in a unit of something else",
            |bench| bench.write("move.csv", &moves("x [N]", |k| Some(0.05 * f64::from(k)))),
            "greybox control model.toml --reference move.csv --out out",
        ),
        with(
            "a reference that does not move",
            |bench| bench.write("move.csv", &moves("x [m]", |_| Some(0.2))),
            "greybox control model.toml --reference move.csv --out out",
        ),
        with(
            "a reference with a gap",
            |bench| bench.write("move.csv", &moves("x [m]", |k| (k != 20).then_some(0.05 * f64::from(k)))),
            "greybox control model.toml --reference move.csv --out out",
        ),
        all(
            "a reference and a set point",
            "greybox control model.toml --reference run.csv --to 0.2 --out out",
        ),
        all("a feed-forward of no reference", "greybox control model.toml --feed-forward static --out out"),
        all("a loop that is early", "greybox control model.toml --delay -0.1 --out out"),
        all("a report that is missing", "greybox control model.toml --report report.json --out out"),
    ]
}

fn places() -> Vec<Row> {
    const S: &str = "Where the results go";
    vec![
        Row::new(
            S,
            "a file in the place of the results",
            NOTHING,
            "greybox diagnose model.toml run.csv --out run.csv",
        ),
        Row::new(
            S,
            "a place below a file",
            NOTHING,
            "greybox diagnose model.toml run.csv --out run.csv/results/first",
        ),
        Row::new(S, "a place without a name", NOTHING, "greybox diagnose model.toml run.csv --out ''"),
        Row::new(
            S,
            "a place that cannot be written",
            NOTHING,
            "greybox diagnose model.toml run.csv --out /proc/greybox",
        ),
        Row::new(
            S,
            "results in the place of the model",
            |b| {
                fs::create_dir(b.path("out")).unwrap();
                b.write("out/improved.toml", MODEL);
            },
            "greybox diagnose out/improved.toml run.csv --out out",
        ),
        Row::new(
            S,
            "a simulation in the place of its recording",
            NOTHING,
            "greybox simulate model.toml run.csv --out run.csv",
        ),
        Row::new(
            S,
            "a device in the place of the result",
            NOTHING,
            "greybox simulate model.toml run.csv --out /dev/full",
        ),
        Row::new(
            S,
            "a folder in the place of the result",
            |b| fs::create_dir(b.path("out")).unwrap(),
            "greybox simulate model.toml run.csv --out out",
        ),
        Row::new(S, "a template in the place of a file", NOTHING, "greybox new servo --out model.toml"),
        Row::new(S, "standard output on a full disk", NOTHING, "greybox check run.csv > /dev/full"),
        Row::new(
            S,
            "results on a full disk (here: files may have 4 KiB at most)",
            NOTHING,
            "trap '' XFSZ; ulimit -f 8; greybox diagnose model.toml run.csv --work 1 --out out",
        ),
        Row {
            held: Some("out"),
            ..Row::new(
                S,
                "a folder of results that another run is writing to",
                |b| {
                    fs::create_dir(b.path("runs")).unwrap();
                    fs::create_dir(b.path("out")).unwrap();
                    b.write("runs/monday.csv", &recording(60, 0.0));
                },
                "greybox diagnose model.toml runs --out out",
            )
        },
        Row::new(
            S,
            "two recordings whose results go to one folder",
            |b| {
                fs::create_dir(b.path("runs")).unwrap();
                b.write("runs/monday.CSV", &recording(60, 0.0));
                b.write("runs/monday.csv", &recording(60, 0.0));
            },
            "greybox diagnose model.toml runs --out out",
        ),
    ]
}

fn limits() -> Vec<Row> {
    const S: &str = "Searches that meet their limit";
    let reported = |what, run| Row { code: 0, ..Row::new(S, what, NOTHING, run) };
    vec![
        reported(
            "a search with too little work",
            "greybox diagnose model.toml run.csv --work 0 --out out | grep -A 1 limit",
        ),
        reported(
            "an identification with too little work",
            "greybox identify run.csv --states x --inputs f --order 2 --work 0 --out out | grep -A 1 limit",
        ),
    ]
}
