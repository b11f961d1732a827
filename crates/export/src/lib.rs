#![doc = include_str!("../README.md")]

mod error;
mod function;
mod graph;
mod language;

pub use error::ExportError;
pub use function::{Constant, Function, Group, Member, Vector};
pub use language::Language;
