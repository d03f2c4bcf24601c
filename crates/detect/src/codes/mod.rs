//! Code words of the tag families.

mod tag16h5;
mod tag25h9;
mod tag36h11;
mod tag41h12;

pub(crate) use tag16h5::TAG16H5;
pub(crate) use tag25h9::TAG25H9;
pub(crate) use tag36h11::TAG36H11;
pub(crate) use tag41h12::TAG41H12;
