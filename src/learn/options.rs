//! Options of training: Algorithm 1 of the paper and the PPO of its two players.
//!
//! Every number has its default and its reason in `configs/default.toml`, which is embedded in the
//! program; these types have no defaults of their own.

use serde::{Deserialize, Serialize};

/// The most updates of a run.
pub const MOST_UPDATES: u64 = 10_000_000;

/// How the two players are trained against each other (Algorithm 1).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TrainOptions {
    /// Environment steps of a run.
    pub steps: u64,
    /// Parallel episodes N of a rollout.
    pub parallel_episodes: usize,
    /// Steps of each parallel episode per update; a rollout has `parallel_episodes * rollout_steps`
    /// environment steps.
    pub rollout_steps: usize,
    /// K: updates of the follower per update of the leader.
    pub follower_updates: u32,
    /// Who leads; the other is updated K times per update of the leader (Corollary 1 swaps them).
    pub leader: Role,
    /// Which action the protagonist's update credits.
    pub credit: Credit,
    /// Share of the episodes that start anywhere, at the beginning of the run; it falls linearly.
    pub exploring_starts: f64,
    /// Share of the run after which every episode starts where episodes start.
    pub exploring_until: f64,
    /// Share of the run that is played at budget 1, in [0, 1).
    pub budget_wait: f64,
    /// Share of the run over which the budget then rises from 1 to eta, linearly in log eta.
    pub budget_rise: f64,
    /// Share of the run at its end in which only the antagonist is updated, against the greedy
    /// protagonist: a best response to the final policy.
    pub response: f64,
    /// How both players see the world.
    pub observation: View,
    /// Who reweights chance.
    pub adversary: Adversary,
    /// What the antagonist reweights.
    pub antagonist_acts: Acts,
    /// What the protagonist's critic sees.
    pub critic_sees: CriticSees,
    /// Hides the remaining budget from the antagonist (an ablation).
    pub hide_budget: bool,
    /// Whether the antagonist's gradient counts what it spends (see [`super::budget_sensitivity`]).
    pub budget_sensitivity: bool,
    /// The protagonist.
    pub protagonist: PlayerOptions,
    /// The protagonist's law of continuous actions.
    pub policy: PlaneLaw,
    /// Standard deviation of the protagonist's continuous actions at the start.
    pub initial_std: f64,
    /// The antagonist.
    pub antagonist: PlayerOptions,
    /// What the antagonist's likelihood ratios are made of.
    pub family: FamilyOptions,
}

impl TrainOptions {
    /// Environment steps of one rollout.
    pub fn rollout(&self) -> u64 {
        (self.parallel_episodes * self.rollout_steps) as u64
    }

    /// Updates of a run: as many as `steps` need, the last of which may exceed them.
    pub fn updates(&self) -> u64 {
        self.steps.div_ceil(self.rollout())
    }

    /// Environment steps of a run: whole updates.
    pub fn whole_steps(&self) -> u64 {
        self.updates().saturating_mul(self.rollout())
    }

    /// What to say where [`TrainOptions::whole_steps`] are not those that were asked for.
    pub fn rounding(&self) -> Option<String> {
        let (asked, made, update) = (self.steps, self.whole_steps(), self.rollout());
        (asked != made).then(|| {
            format!(
                "train.steps = {asked} is rounded up to {made}: an update takes {update} steps \
                 (train.parallel_episodes * train.rollout_steps)"
            )
        })
    }
}

/// A player of the game.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Role {
    /// Chooses the actions.
    Protagonist,
    /// Reweights chance.
    Antagonist,
}

impl Role {
    /// The other player.
    pub fn other(self) -> Role {
        match self {
            Role::Protagonist => Role::Antagonist,
            Role::Antagonist => Role::Protagonist,
        }
    }

    /// The name in files and messages.
    pub fn name(self) -> &'static str {
        match self {
            Role::Protagonist => "protagonist",
            Role::Antagonist => "antagonist",
        }
    }
}

impl std::fmt::Display for Role {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(self.name())
    }
}

/// Which action the protagonist's probability ratio is about.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Credit {
    /// The action it chose.
    Chosen,
    /// The move that was executed: the published code's behaviour; only where chance decides a move.
    Executed,
}

/// How the players see the world (see [`super::observation`]).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum View {
    /// As the few numbers that the world describes a state with.
    Coordinates,
    /// As features in which a network can turn sharply: one-hot states of a finite world, a Fourier basis
    /// of the position in any other.
    Features,
}

/// What the protagonist's critic sees (see [`super::observation`]).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum CriticSees {
    /// What the protagonist sees.
    Observation,
    /// The time and the antagonist's remaining budget as well.
    Game,
}

/// The protagonist's law of pushes in the plane (see [`super::plane`]).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum PlaneLaw {
    /// Gaussian; the world scales longer pushes onto the unit disc.
    Gaussian,
    /// On the unit disc.
    Disc,
}

/// Who reweights chance.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Adversary {
    /// The antagonist that learns.
    Learned,
    /// One without memory that draws the parameters of each step's perturbation from N(0, 1)
    /// (an ablation).
    Random,
}

/// What the antagonist reweights in a step.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Acts {
    /// The law of the outcome, after the action is drawn: the paper's game.
    Outcome,
    /// The protagonist's own draw as well.
    Joint,
}

/// Options of one PPO player.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PlayerOptions {
    /// Tanh units of the one hidden layer, of actor and of critic each.
    pub hidden: usize,
    /// Whether the player sees the time t / T.
    pub time_aware: bool,
    /// Adam's learning rate at the player's first update.
    pub learning_rate: f64,
    /// Adam's learning rate at the player's last update; linear in between.
    pub learning_rate_final: f64,
    /// Passes over a rollout per update.
    pub epochs: u32,
    /// Samples of a minibatch.
    pub minibatch: usize,
    /// Clip range of the probability ratio.
    pub clip: f64,
    /// Lambda of generalised advantage estimation.
    pub gae_lambda: f64,
    /// Weight of the entropy bonus at the player's first update.
    pub entropy: f64,
    /// Weight of the entropy bonus at the player's last update; linear in between.
    pub entropy_final: f64,
    /// Weight of the value loss.
    pub value_coefficient: f64,
    /// Largest norm of the gradient; a longer one is scaled down to it.
    pub gradient_norm: f64,
}

/// The antagonist's family of perturbations. The bounds keep log M finite.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FamilyOptions {
    /// Name of the family; `auto` is the default one of the world's law of chance.
    pub kind: String,
    /// bumps, probits: number of components whose weighted sum the likelihood ratio is.
    pub count: usize,
    /// bumps: bound of |c|, in standard deviations of the noise. probits: bound of |a|.
    pub center: f64,
    /// bumps: bound of the eigenvalues of K. probits: bound of |w|^2.
    pub curvature: f64,
}
