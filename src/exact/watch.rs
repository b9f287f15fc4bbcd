//! Following a computation that takes minutes.

/// Somebody who is told how far a computation is. Several threads may tell it at once.
pub trait Watch: Sync {
    /// The share that is done, from 0 to 1; an estimate of time.
    fn done(&self, share: f64);

    /// Something that the user should know and that does not end the computation.
    fn note(&self, _text: &str) {}
}

/// Nobody.
impl Watch for () {
    fn done(&self, _: f64) {}
}

/// One step after another of a computation whose steps have known costs.
pub struct Steps<'a> {
    watch: &'a dyn Watch,
    total: f64,
    before: f64,
}

impl<'a> Steps<'a> {
    /// Steps that cost `total` together, in any unit.
    pub fn new(watch: &'a dyn Watch, total: f64) -> Steps<'a> {
        Steps { watch, total, before: 0.0 }
    }

    /// Who is told about the next step, which has this cost.
    pub fn next(&mut self, cost: f64) -> Step<'a> {
        let from = self.before / self.total;
        self.before += cost;
        Step { watch: self.watch, from, to: self.before / self.total }
    }
}

/// One step of [`Steps`].
pub struct Step<'a> {
    watch: &'a dyn Watch,
    from: f64,
    to: f64,
}

impl Watch for Step<'_> {
    fn done(&self, share: f64) {
        self.watch.done((self.from + (self.to - self.from) * share).min(1.0));
    }

    fn note(&self, text: &str) {
        self.watch.note(text);
    }
}
