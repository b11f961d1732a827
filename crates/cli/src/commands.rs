//! The subcommands, one file each.

pub(crate) mod calibrate;
pub(crate) mod check;
pub(crate) mod compare;
pub(crate) mod control;
pub(crate) mod demo;
pub(crate) mod diagnose;
pub(crate) mod export;
pub(crate) mod identify;
pub(crate) mod mechanisms;
pub(crate) mod new;
pub(crate) mod shell;
pub(crate) mod simulate;
pub(crate) mod watch;
