//! What is kept: captures, the card and its index.

#[path = "../common/leave_out.rs"]
mod leave_out;
mod capture;
mod card;
mod store;
