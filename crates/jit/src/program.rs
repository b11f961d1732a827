//! What a program says: operations on registers, and the rules of their tangents.

/// A function of one number that a program calls.
#[cfg(target_arch = "x86_64")]
pub type Unary = extern "sysv64" fn(f64) -> f64;
/// A function of two numbers that a program calls.
#[cfg(target_arch = "x86_64")]
pub type Binary = extern "sysv64" fn(f64, f64) -> f64;
/// A function of a number and an integer that a program calls.
#[cfg(target_arch = "x86_64")]
pub type Power = extern "sysv64" fn(f64, i32) -> f64;

/// A function of one number that a program calls.
#[cfg(not(target_arch = "x86_64"))]
pub type Unary = extern "C" fn(f64) -> f64;
/// A function of two numbers that a program calls.
#[cfg(not(target_arch = "x86_64"))]
pub type Binary = extern "C" fn(f64, f64) -> f64;
/// A function of a number and an integer that a program calls.
#[cfg(not(target_arch = "x86_64"))]
pub type Power = extern "C" fn(f64, i32) -> f64;

/// Where a number stands.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Operand {
    /// In a register of the caller.
    Register(u32),
    /// Among the numbers that the caller's programs share.
    Shared(u32),
    /// In a register of the program's own, which is gone when it ends.
    Local(u32),
    /// In the program.
    Constant(f64),
}

/// One operation. Each rounds as IEEE 754 says, and nothing is fused: a program gives the bits that the same operations
/// give one by one.
#[derive(Debug, Clone, Copy)]
pub enum Operation {
    /// −a.
    Negative(Operand),
    /// √a.
    Root(Operand),
    /// a + b.
    Sum(Operand, Operand),
    /// a − b.
    Difference(Operand, Operand),
    /// a b.
    Product(Operand, Operand),
    /// a / b.
    Quotient(Operand, Operand),
    /// f(a).
    Unary(Unary, Operand),
    /// f(a, b).
    Binary(Binary, Operand, Operand),
    /// f(a, n).
    Power(Power, Operand, i32),
    /// Mode k as a number.
    Mode(u32),
    /// Mode k as a number, or the held value k where the mode is 0.
    HeldMode(u32),
    /// One of three numbers, by the sign of mode k: where it is negative, zero and positive.
    Select(u32, [Operand; 3]),
}

/// Operations in their order, each with where its result goes.
pub type Operations = Vec<(Operand, Operation)>;

/// Rules in their order, each with its row.
pub type Rules = Vec<(u32, Rule)>;

/// The tangents of one register, lane by lane, from those of others.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Row {
    /// 0.
    Zero,
    /// da.
    Copy(u32),
    /// da + db.
    Sum(u32, u32),
    /// da − db.
    Difference(u32, u32),
    /// k da.
    Scale(Operand, u32),
    /// da + k db.
    PlusScaled(u32, Operand, u32),
    /// da − k db.
    MinusScaled(u32, Operand, u32),
    /// k da + l db.
    Blend(Operand, u32, Operand, u32),
}

/// What gives a row.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Rule {
    /// This.
    Always(Row),
    /// One of three, by the sign of mode k: where it is negative, zero and positive.
    Select(u32, [Row; 3]),
}
