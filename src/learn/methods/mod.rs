//! The methods: a file each. [`game`] is the paper's; the others are compared with it.

pub mod game;
pub mod uniform;

pub use game::Game;
pub use uniform::Uniform;
