//! What is kept: captures, the card and its index.

mod capture;
mod card;
mod store;
