//! The `greybox` command.
fn main() {}
