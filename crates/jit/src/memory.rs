//! Machine code in memory that may be run. All of this crate's `unsafe` is here.
#![allow(unsafe_code)]

use memmap2::{Mmap, MmapMut};

use crate::assembler::Width;

/// A program: what it may touch is known to whoever made it.
type Entry = unsafe extern "sysv64" fn(*mut f64, *const i8, *const f64, *mut f64);

/// Code that can be run and no longer written.
pub(crate) struct Executable(Mmap);

impl Executable {
    /// `None` where the system refuses.
    pub(crate) fn new(code: &[u8]) -> Option<Executable> {
        let mut pages = MmapMut::map_anon(code.len()).ok()?;
        pages.copy_from_slice(code);
        pages.make_exec().ok().map(Executable)
    }

    /// Runs the program at `entry`.
    ///
    /// # Safety
    /// A program of the compiler begins at `entry`, made for a processor with the instructions of this one. It reads and
    /// writes no entry of `registers`, `modes`, `held` and `shared` beyond their ends.
    pub(crate) unsafe fn run(
        &self,
        entry: usize,
        registers: &mut [f64],
        modes: &[i8],
        held: &[f64],
        shared: &mut [f64],
    ) {
        // SAFETY: the pages are readable and executable, and live as long as `self`; a program begins at `entry`, and follows
        // the calling convention of its type: it keeps the registers that a callee keeps, and returns.
        let program = unsafe { std::mem::transmute::<*const u8, Entry>(self.0.as_ptr().add(entry)) };
        // SAFETY: the caller answers for what it reads and writes; the slices are borrowed for the call, and what is written
        // borrowed alone.
        unsafe {
            program(registers.as_mut_ptr(), modes.as_ptr(), held.as_ptr(), shared.as_mut_ptr());
        }
    }

    /// Runs a program that reads `registers` and does not write them.
    ///
    /// # Safety
    /// As [`run`](Self::run), and no operation of the program writes a register of the caller.
    pub(crate) unsafe fn run_reading(
        &self,
        entry: usize,
        registers: &[f64],
        modes: &[i8],
        tangents: &mut [f64],
    ) {
        // SAFETY: as in `run`.
        let program = unsafe { std::mem::transmute::<*const u8, Entry>(self.0.as_ptr().add(entry)) };
        // SAFETY: as in `run`; nothing is written through the pointer to the registers.
        unsafe {
            program(registers.as_ptr().cast_mut(), modes.as_ptr(), std::ptr::null(), tangents.as_mut_ptr());
        }
    }
}

impl std::fmt::Debug for Executable {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{} bytes of machine code", self.0.len())
    }
}

/// The widest vectors of this processor, if it has those that programs need at all.
pub(crate) fn widest() -> Option<Width> {
    if std::arch::is_x86_feature_detected!("avx512f") {
        Some(Width::Eight)
    } else if std::arch::is_x86_feature_detected!("avx") {
        Some(Width::Four)
    } else {
        None
    }
}
