//! The simulated machines of the concealed suite, with the effects that are concealed in them. Nothing here is shared with
//! greybox's own simulator or its library of mechanisms.

pub mod excite;
pub mod family;
pub mod kind;
pub mod machine;
pub mod text;
