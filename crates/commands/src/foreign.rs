//! Files of other tools in the place of a model or a recording: what they are, and where their physics stands.

use std::fs::File;
use std::io::Read;
use std::path::Path;

use crate::failure::Failure;

/// Bytes from which a content is known.
const HEAD: u64 = 4096;

/// A kind of file that greybox does not read.
#[derive(Debug, PartialEq, Eq)]
pub(crate) struct Kind {
    /// Endings of its files.
    endings: &'static [&'static str],
    /// What it is, with its article.
    what: &'static str,
    /// Where in it the equations stand, or what of it goes where.
    physics: &'static str,
}

const FMU: Kind = Kind {
    endings: &["fmu"],
    what: "a Functional Mock-up Unit",
    physics: "it is compiled and holds none, so take them from the tool that made it (names, units and start values stand in \
              its modelDescription.xml)",
};
const SIMULINK: Kind = Kind {
    endings: &["slx", "mdl"],
    what: "a Simulink model",
    physics: "what enters an Integrator block is the derivative of a state, and gains go to [parameters]",
};
const URDF: Kind = Kind {
    endings: &["urdf", "xacro"],
    what: "a robot description (URDF)",
    physics: "masses and inertias of <inertial>, damping and friction of <dynamics> go to [parameters]; the equations \
              themselves follow from its links and joints",
};
const SDF: Kind = Kind {
    endings: &["sdf"],
    what: "a description of a simulated world (SDF)",
    physics: "masses and inertias of <inertial>, damping, friction and spring_stiffness of <dynamics> go to [parameters]; \
              the equations themselves follow from its links and joints",
};
const MJCF: Kind = Kind {
    endings: &["mjcf"],
    what: "a MuJoCo model",
    physics: "masses and inertias of <inertial>, damping, stiffness, armature and frictionloss of <joint> go to \
              [parameters]; the equations themselves follow from its bodies and joints",
};
const PYTHON: Kind = Kind {
    endings: &["py"],
    what: "a Python program",
    physics: "what the function given to the integrator returns goes to [equations], its constants to [parameters]",
};
const NOTEBOOK: Kind = Kind {
    endings: &["ipynb"],
    what: "a notebook",
    physics: "what the function given to the integrator returns goes to [equations], its constants to [parameters]",
};
const MATLAB: Kind = Kind {
    endings: &["m", "mlx"],
    what: "a MATLAB program",
    physics: "what the function given to the solver (such as ode45) returns goes to [equations], its constants to \
              [parameters]",
};
const JULIA: Kind = Kind {
    endings: &["jl"],
    what: "a Julia program",
    physics: "what the function given to the solver returns goes to [equations], its constants to [parameters]",
};
const MODELICA: Kind = Kind {
    endings: &["mo"],
    what: "a Modelica model",
    physics: "its `equation` section goes to [equations], with x' for der(x), and each `parameter` to [parameters]",
};
const SHEET: Kind = Kind {
    endings: &["xlsx", "xls", "ods"],
    what: "a spreadsheet",
    physics: "values in it go to [parameters]",
};
const XML: Kind = Kind {
    endings: &["xml"],
    what: "an XML file",
    physics: "masses, stiffnesses, damping and friction in it go to [parameters]",
};
const ZIP: Kind =
    Kind { endings: &["zip"], what: "a ZIP archive", physics: "unpack it first and see what it holds" };

const KINDS: [&Kind; 13] =
    [&FMU, &SIMULINK, &URDF, &SDF, &MJCF, &PYTHON, &NOTEBOOK, &MATLAB, &JULIA, &MODELICA, &SHEET, &XML, &ZIP];

/// The kind of the file at `path`: by the ending of its name, else by how it begins. `None` for any other file, and where
/// there is none.
pub(crate) fn of(path: &Path) -> Option<&'static Kind> {
    // Archives of NumPy arrays are recordings, though they begin as other archives do.
    if !path.is_file() || path.extension().is_some_and(|e| e.eq_ignore_ascii_case("npz")) {
        return None;
    }
    let mut head = Vec::new();
    // What cannot be read is reported by who reads it.
    File::open(path).and_then(|file| file.take(HEAD).read_to_end(&mut head)).ok()?;
    kind(path.extension().and_then(|e| e.to_str()).unwrap_or_default(), &head)
}

/// The kind of a file with this ending that begins so.
fn kind(ending: &str, head: &[u8]) -> Option<&'static Kind> {
    let named = KINDS.into_iter().find(|kind| kind.endings.iter().any(|e| e.eq_ignore_ascii_case(ending)));
    // Robots of MuJoCo are called `.xml`.
    named.filter(|kind| **kind != XML).or_else(|| begun(head)).or(named)
}

/// The kind of a file that begins so.
fn begun(head: &[u8]) -> Option<&'static Kind> {
    if head.starts_with(b"PK\x03\x04") {
        return Some(&ZIP);
    }
    let text = String::from_utf8_lossy(head);
    let text = text.trim_start_matches('\u{feff}').trim_start();
    if !text.starts_with('<') {
        return None;
    }
    let roots = [("<robot", &URDF), ("<sdf", &SDF), ("<mujoco", &MJCF)];
    Some(roots.into_iter().find(|(root, _)| text.contains(root)).map_or(&XML, |(_, kind)| kind))
}

impl Kind {
    /// The error where a model was to be.
    pub(crate) fn as_model(&self, path: &Path) -> Failure {
        let message = format!("this is {}, but a model (TOML) is needed here", self.what);
        Failure::file(path, message).help(format!(
            "write its equations down as a TOML model: {}. `greybox new --list` names models to start from, the page \
             `model-language` of the book has the language; `greybox export` goes the other way, to Python, Modelica and \
             LaTeX",
            self.physics
        ))
    }

    /// The error where a recording was to be.
    pub(crate) fn as_recording(&self, path: &Path) -> Failure {
        let message = format!("this is {}, but a recording is needed here", self.what);
        let how = match *self == SHEET {
            true => "export the sheet as CSV",
            false => "log the signals, of the machine or of the simulation, into such a file",
        };
        Failure::file(path, message).help(format!(
            "greybox reads recordings from CSV (a header row such as `t,u [V],y [m]`), MAT-files, HDF5, NumPy, MCAP logs and Parquet: {how}"
        ))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn endings_and_beginnings_tell_the_kind() {
        let xml = b"<?xml version=\"1.0\"?>\n<!-- arm -->\n<robot name=\"arm\">";
        for (ending, head, expected) in [
            ("urdf", &b""[..], Some(&URDF)),
            ("URDF", b"", Some(&URDF)),
            ("fmu", b"PK\x03\x04rest", Some(&FMU)),
            ("slx", b"PK\x03\x04rest", Some(&SIMULINK)),
            ("mdl", b"Model {", Some(&SIMULINK)),
            ("mo", b"model A", Some(&MODELICA)),
            ("xlsx", b"PK\x03\x04", Some(&SHEET)),
            ("xml", xml, Some(&URDF)),
            ("xml", b"\xef\xbb\xbf <mujoco model=\"a\">", Some(&MJCF)),
            ("xml", b"<a/>", Some(&XML)),
            ("xml", b"", Some(&XML)),
            ("toml", xml, Some(&URDF)),
            ("toml", b"PK\x03\x04", Some(&ZIP)),
            ("toml", b"[states]\nx = {}", None),
            ("", b"", None),
            ("csv", b"t,x\n0,1\n\xff", None),
        ] {
            assert_eq!(kind(ending, head), expected, "{ending} {}", String::from_utf8_lossy(head));
        }
    }

    #[test]
    fn every_kind_says_where_to_look() {
        for kind in KINDS {
            let reported = kind.as_model("a.x".as_ref()).to_string();
            for part in [kind.what, "TOML", kind.physics, "`greybox new --list`", "`greybox export`"] {
                assert!(reported.contains(part), "{reported}");
            }
            let reported = kind.as_recording("a.x".as_ref()).to_string();
            assert!(reported.contains("CSV") && reported.contains("Parquet"), "{reported}");
        }
        assert!(of("nowhere.urdf".as_ref()).is_none() && of(".".as_ref()).is_none());
    }
}
