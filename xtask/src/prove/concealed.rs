//! The concealed suite: machines with something left out, made from a seed, and how greybox does on them.

mod case;
mod excite;
mod kind;
mod machine;
mod plan;
mod text;
