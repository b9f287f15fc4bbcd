//! The methods: a file each. [`game`] is the paper's; the others are compared with it.

pub mod augmented;
pub mod cvar_pg;
pub mod game;
pub mod iqn;
pub mod neutral;
pub mod rarl;
pub mod return_capping;
pub mod uniform;

pub use augmented::Augmented;
pub use cvar_pg::CvarPg;
pub use game::Game;
pub use iqn::Iqn;
pub use neutral::Neutral;
pub use rarl::Rarl;
pub use return_capping::ReturnCapping;
pub use uniform::Uniform;
