#![doc = include_str!("../README.md")]

mod error;
mod function;
mod graph;
mod infix;
mod keywords;
mod language;
mod latex;
mod modelica;
mod names;
mod observer;
mod python;

pub use error::ExportError;
pub use function::{Constant, Function, Group, Member, Vector};
pub use language::Language;
pub use latex::{latex, latex_document};
pub use modelica::modelica;
pub use observer::{ChainForm, ObserverCode, ObserverForm, RestForm, StartForm};
pub use python::python;
