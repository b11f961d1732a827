//! The few instructions of x86-64 that a program needs, as bytes.
//!
//! Source: Intel 64 and IA-32 Architectures Software Developer's Manual, volume 2: sections 2.3 (VEX), 2.7 (EVEX) and the
//! instructions' pages.

/// A general register by its number.
pub(crate) type General = u8;

pub(crate) const RAX: General = 0;
pub(crate) const RDX: General = 2;
pub(crate) const RBX: General = 3;
pub(crate) const RSP: General = 4;
pub(crate) const RBP: General = 5;
pub(crate) const RSI: General = 6;
pub(crate) const RDI: General = 7;
pub(crate) const RCX: General = 1;
pub(crate) const R13: General = 13;
pub(crate) const R14: General = 14;

/// A vector register by its number, 0 to 15.
pub(crate) type Vector = u8;

/// How many numbers an instruction works on.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Width {
    One,
    Two,
    Four,
    Eight,
}

impl Width {
    pub(crate) fn lanes(self) -> usize {
        match self {
            Width::One => 1,
            Width::Two => 2,
            Width::Four => 4,
            Width::Eight => 8,
        }
    }

    fn at_least_two(self) -> Width {
        if self == Width::One { Width::Two } else { self }
    }
}

/// The second source of an instruction.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Source {
    Vector(Vector),
    Memory(General, i32),
    /// An entry of the constants behind the code.
    Constant(usize),
}

/// Arithmetic of two sources.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Arithmetic {
    Add,
    Multiply,
    Subtract,
    Divide,
}

impl Arithmetic {
    fn opcode(self) -> u8 {
        match self {
            Arithmetic::Add => 0x58,
            Arithmetic::Multiply => 0x59,
            Arithmetic::Subtract => 0x5C,
            Arithmetic::Divide => 0x5E,
        }
    }
}

/// When a jump is taken, of the mode that was tested.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Condition {
    Zero,
    Negative,
    NotPositive,
    Always,
}

/// A jump whose end is not yet known.
#[must_use]
pub(crate) struct Jump(usize);

/// Bytes of a constant: as many as the widest that is read at once from there.
const CONSTANT: usize = 16;

#[derive(Default)]
pub(crate) struct Assembler {
    code: Vec<u8>,
    constants: Vec<u64>,
    /// Where the distance to a constant stands.
    open: Vec<(usize, usize)>,
}

/// What precedes an opcode.
#[derive(Clone, Copy)]
struct Prefix {
    /// 0: none, 1: 66, 2: F3, 3: F2.
    pp: u8,
    /// 1: 0F, 2: 0F38.
    map: u8,
}

const PACKED: Prefix = Prefix { pp: 1, map: 1 };
const SCALAR: Prefix = Prefix { pp: 3, map: 1 };

impl Assembler {
    pub(crate) fn position(&self) -> usize {
        self.code.len()
    }

    /// The number of a constant.
    pub(crate) fn constant(&mut self, value: f64) -> usize {
        let bits = value.to_bits();
        self.constants.iter().position(|c| *c == bits).unwrap_or_else(|| {
            self.constants.push(bits);
            self.constants.len() - 1
        })
    }

    /// The code with its constants behind it.
    pub(crate) fn finish(mut self) -> Vec<u8> {
        self.code.resize(self.code.len().next_multiple_of(CONSTANT), 0xCC);
        let first = self.code.len();
        for (at, constant) in std::mem::take(&mut self.open) {
            let distance = (first + constant * CONSTANT) as i64 - (at as i64 + 4);
            self.code[at..at + 4].copy_from_slice(&(distance as i32).to_le_bytes());
        }
        for constant in &self.constants {
            self.code.extend_from_slice(&constant.to_le_bytes());
            self.code.extend_from_slice(&constant.to_le_bytes());
        }
        self.code
    }

    fn bytes(&mut self, bytes: &[u8]) {
        self.code.extend_from_slice(bytes);
    }

    /// ModR/M, and what follows it, for a register and a source.
    fn modrm(&mut self, register: u8, source: Source) {
        let reg = (register & 7) << 3;
        match source {
            Source::Vector(v) => self.bytes(&[0xC0 | reg | (v & 7)]),
            Source::Memory(base, displacement) => {
                self.bytes(&[0x80 | reg | (base & 7)]);
                if base & 7 == RSP {
                    self.bytes(&[0x24]);
                }
                self.bytes(&displacement.to_le_bytes());
            }
            Source::Constant(constant) => {
                self.bytes(&[0x05 | reg]);
                self.open.push((self.code.len(), constant));
                self.bytes(&[0; 4]);
            }
        }
    }

    /// One vector instruction.
    fn vector(
        &mut self,
        prefix: Prefix,
        width: Width,
        opcode: u8,
        (to, first, second): (Vector, Vector, Source),
        broadcast: bool,
    ) {
        let high = match second {
            Source::Vector(v) => v >> 3,
            Source::Memory(base, _) => base >> 3,
            Source::Constant(_) => 0,
        };
        let (r, b) = ((to >> 3) ^ 1, high ^ 1);
        if width == Width::Eight {
            // (R′, V′ and X are not used: sixteen registers suffice, and no address has an index.)
            self.bytes(&[
                0x62,
                r << 7 | 1 << 6 | b << 5 | 1 << 4 | prefix.map,
                1 << 7 | (!first & 15) << 3 | 1 << 2 | prefix.pp,
                0b10 << 5 | u8::from(broadcast) << 4 | 1 << 3,
                opcode,
            ]);
        } else {
            let long = u8::from(width == Width::Four);
            self.bytes(&[
                0xC4,
                r << 7 | 1 << 6 | b << 5 | prefix.map,
                (!first & 15) << 3 | long << 2 | prefix.pp,
                opcode,
            ]);
        }
        self.modrm(to, second);
    }

    fn prefix(width: Width) -> Prefix {
        if width == Width::One { SCALAR } else { PACKED }
    }

    /// to = first ∘ second.
    pub(crate) fn arithmetic(
        &mut self,
        width: Width,
        op: Arithmetic,
        to: Vector,
        first: Vector,
        second: Source,
    ) {
        self.vector(Self::prefix(width), width, op.opcode(), (to, first, second), false);
    }

    /// to = first times one number in memory, eight lanes.
    pub(crate) fn multiply_by(&mut self, to: Vector, first: Vector, factor: Source) {
        let opcode = Arithmetic::Multiply.opcode();
        self.vector(PACKED, Width::Eight, opcode, (to, first, factor), true);
    }

    /// to = √second.
    pub(crate) fn root(&mut self, to: Vector, second: Source) {
        // (The upper half comes from the first source: from the register that is written, so that nothing else is waited for.)
        self.vector(SCALAR, Width::One, 0x51, (to, to, second), false);
    }

    /// to = −first.
    pub(crate) fn negative(&mut self, to: Vector, first: Vector) {
        let sign = self.constant(f64::from_bits(1 << 63));
        self.vector(PACKED, Width::Two, 0x57, (to, first, Source::Constant(sign)), false);
    }

    /// to = 0.
    pub(crate) fn zero(&mut self, to: Vector) {
        // (What is written to 256 bits is zero above them.)
        self.vector(PACKED, Width::Four, 0x57, (to, to, Source::Vector(to)), false);
    }

    pub(crate) fn load(&mut self, width: Width, to: Vector, from: Source) {
        match from {
            // (vmovapd)
            Source::Vector(_) => self.vector(PACKED, width.at_least_two(), 0x28, (to, 0, from), false),
            _ => self.vector(Self::prefix(width), width, 0x10, (to, 0, from), false),
        }
    }

    pub(crate) fn store(&mut self, width: Width, base: General, displacement: i32, from: Vector) {
        self.vector(Self::prefix(width), width, 0x11, (from, 0, Source::Memory(base, displacement)), false);
    }

    /// Every lane of `to` = one number in memory.
    pub(crate) fn broadcast(&mut self, width: Width, to: Vector, from: Source) {
        match width {
            Width::One => self.load(Width::One, to, from),
            // vmovddup
            Width::Two => self.vector(SCALAR, Width::Two, 0x12, (to, 0, from), false),
            // vbroadcastsd
            Width::Four | Width::Eight => {
                self.vector(Prefix { pp: 1, map: 2 }, width, 0x19, (to, 0, from), false);
            }
        }
    }

    /// to = the integer in eax.
    pub(crate) fn convert_integer(&mut self, to: Vector) {
        self.zero(to);
        self.vector(SCALAR, Width::One, 0x2A, (to, to, Source::Vector(RAX)), false);
    }

    /// eax = the byte there, and the flags are those of it.
    pub(crate) fn test_byte(&mut self, base: General, displacement: i32) {
        if base >= 8 {
            self.bytes(&[0x41]);
        }
        self.bytes(&[0x0F, 0xBE]);
        self.modrm(RAX, Source::Memory(base, displacement));
        self.bytes(&[0x85, 0xC0]);
    }

    pub(crate) fn jump(&mut self, condition: Condition) -> Jump {
        match condition {
            Condition::Zero => self.bytes(&[0x0F, 0x84]),
            Condition::Negative => self.bytes(&[0x0F, 0x88]),
            Condition::NotPositive => self.bytes(&[0x0F, 0x8E]),
            Condition::Always => self.bytes(&[0xE9]),
        }
        self.bytes(&[0; 4]);
        Jump(self.code.len())
    }

    /// The jump ends here.
    pub(crate) fn land(&mut self, jump: Jump) {
        let distance = (self.code.len() - jump.0) as i32;
        self.code[jump.0 - 4..jump.0].copy_from_slice(&distance.to_le_bytes());
    }

    pub(crate) fn push(&mut self, register: General) {
        if register >= 8 {
            self.bytes(&[0x41]);
        }
        self.bytes(&[0x50 | (register & 7)]);
    }

    pub(crate) fn pop(&mut self, register: General) {
        if register >= 8 {
            self.bytes(&[0x41]);
        }
        self.bytes(&[0x58 | (register & 7)]);
    }

    /// to = from, 64 bits.
    pub(crate) fn copy(&mut self, to: General, from: General) {
        self.bytes(&[0x48 | (from >> 3) << 2 | (to >> 3), 0x89, 0xC0 | (from & 7) << 3 | (to & 7)]);
    }

    /// Room on the stack, in bytes; negative: given back.
    pub(crate) fn make_room(&mut self, bytes: i32) {
        if bytes >= 0 {
            self.bytes(&[0x48, 0x81, 0xEC]);
            self.bytes(&bytes.to_le_bytes());
        } else {
            self.bytes(&[0x48, 0x81, 0xC4]);
            self.bytes(&(-bytes).to_le_bytes());
        }
    }

    /// edi = an integer.
    pub(crate) fn integer(&mut self, value: i32) {
        self.bytes(&[0xBF]);
        self.bytes(&value.to_le_bytes());
    }

    /// Calls a function at a known address.
    pub(crate) fn call(&mut self, address: u64) {
        self.bytes(&[0x48, 0xB8]);
        self.bytes(&address.to_le_bytes());
        self.bytes(&[0xFF, 0xD0]);
    }

    /// Returns, the upper halves of the vector registers cleared.
    pub(crate) fn end(&mut self) {
        self.bytes(&[0xC5, 0xF8, 0x77, 0xC3]);
    }
}
