//! A map drawn as text.
//!
//! One character is one cell, one line is one row; x counts to the right and y downward, both from 0:
//!
//! | character | cell |
//! |---|---|
//! | `S` | start (exactly one) |
//! | `G` | goal (at least one, of either kind) |
//! | `g` | a lesser goal, which pays another reward |
//! | `L` | lava |
//! | `.` | free |
//! | `#` | wall: a move into it leaves the state unchanged, as the edge of the map does |
//!
//! White space around a line and empty lines before and after the picture are ignored, so a map may
//! be indented in its file.

use crate::error::ConfigError;

/// Maps of more cells are refused: nothing here needs them, and a typing error should not fill the
/// memory.
pub const MAX_CELLS: usize = 1_000_000;

/// What a cell of the map is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Tile {
    /// Nothing happens here; the start is free too.
    Free,
    /// Entering it ends the episode badly.
    Lava,
    /// Entering it ends the episode well.
    Goal,
    /// A goal that pays another reward.
    LesserGoal,
    /// It cannot be entered.
    Wall,
}

impl Tile {
    /// Whether entering it ends the episode well.
    pub fn is_goal(self) -> bool {
        matches!(self, Tile::Goal | Tile::LesserGoal)
    }
}

/// A rectangle of tiles with one start. Cells are numbered row by row: cell = y * width + x.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Map {
    width: usize,
    tiles: Vec<Tile>,
    start: usize,
}

impl Map {
    /// Reads a picture.
    ///
    /// # Errors
    /// If the picture is empty, not rectangular, too large, has an unknown character, does not have
    /// exactly one start, or has no goal. The message names the row and the column.
    pub fn parse(picture: &str) -> Result<Map, ConfigError> {
        let error = |row: usize, column: usize, problem: String, remedy: &str| ConfigError::Map {
            row: row + 1,
            column: column + 1,
            problem,
            remedy: remedy.into(),
        };
        let mut tiles = Vec::new();
        let mut width = 0;
        let mut start = None;
        let mut goals = 0;
        let mut blank = None; // an empty line inside the picture, unless nothing follows it
        for (row, text) in picture.lines().enumerate() {
            let indentation = text.chars().take_while(|c| c.is_whitespace()).count();
            let line = text.trim();
            if line.is_empty() {
                if !tiles.is_empty() && blank.is_none() {
                    blank = Some(row);
                }
                continue;
            }
            if let Some(blank) = blank {
                let remedy = "remove the line or fill it with `.`";
                return Err(error(blank, 0, "an empty line inside the map".into(), remedy));
            }
            let before = tiles.len();
            for (offset, character) in line.chars().enumerate() {
                let column = indentation + offset;
                let tile = match character {
                    '.' => Tile::Free,
                    'L' => Tile::Lava,
                    'G' => Tile::Goal,
                    'g' => Tile::LesserGoal,
                    '#' => Tile::Wall,
                    'S' => Tile::Free,
                    _ => {
                        let problem = format!("{character:?} is no cell");
                        let remedy =
                            "use S (start), G (goal), g (lesser goal), L (lava), . (free) or # (wall)"
                                .to_owned();
                        return Err(error(row, column, problem, &remedy));
                    }
                };
                if character == 'S' && start.replace(tiles.len()).is_some() {
                    let remedy = "keep exactly one and write `.` for the others";
                    return Err(error(row, column, "a second start S".into(), remedy));
                }
                goals += usize::from(tile.is_goal());
                if tiles.len() == MAX_CELLS {
                    let problem = format!("the map has more than {MAX_CELLS} cells");
                    return Err(error(row, column, problem, "draw a smaller map"));
                }
                tiles.push(tile);
            }
            let cells = tiles.len() - before;
            if width == 0 {
                width = cells;
            } else if cells != width {
                let problem = format!("the row has {cells} cells where the first row has {width}");
                let column = indentation + cells.min(width);
                return Err(error(row, column, problem, "make all rows equally long"));
            }
        }
        if tiles.is_empty() {
            let remedy = "draw at least one row, with one S and one G";
            return Err(error(0, 0, "the map is empty".into(), remedy));
        }
        let Some(start) = start else {
            return Err(error(0, 0, "the map has no start".into(), "write S into one free cell"));
        };
        if goals == 0 {
            return Err(error(0, 0, "the map has no goal".into(), "write G into a free cell"));
        }
        Ok(Map { width, tiles, start })
    }

    /// Number of moves of the shortest way from the start to a goal that enters neither lava nor a wall;
    /// `None` if there is no such way.
    pub fn moves_to_goal(&self) -> Option<usize> {
        let mut seen = vec![false; self.cells()];
        seen[self.start] = true;
        let (mut reached, mut moves) = (vec![self.start], 0);
        while !reached.is_empty() {
            if reached.iter().any(|&cell| self.tile(cell).is_goal()) {
                return Some(moves);
            }
            let near = reached.iter().flat_map(|&cell| self.neighbours(cell));
            let free = |cell: &usize| !matches!(self.tile(*cell), Tile::Lava | Tile::Wall);
            let new = |cell: &usize| !std::mem::replace(&mut seen[*cell], true);
            reached = near.filter(free).filter(new).collect();
            moves += 1;
        }
        None
    }

    /// The cells above, below, to the right and to the left that are on the map.
    fn neighbours(&self, cell: usize) -> impl Iterator<Item = usize> + use<> {
        let ((x, y), width) = (self.coordinates(cell), self.width);
        let (right, down) = (x + 1 < width, y + 1 < self.height());
        let all = [
            (y > 0).then(|| cell - width),
            down.then(|| cell + width),
            right.then(|| cell + 1),
            (x > 0).then(|| cell - 1),
        ];
        all.into_iter().flatten()
    }

    /// The cells of one kind as few rectangles `[x_min, y_min, x_max, y_max]`, in cells, that do not overlap:
    /// runs of a row, each as many rows downward as they repeat.
    pub fn rectangles(&self, tile: Tile) -> Vec<[usize; 4]> {
        let mut taken = vec![false; self.cells()];
        let mut found = Vec::new();
        for cell in 0..self.cells() {
            let is = |cell: usize, taken: &[bool]| self.tiles[cell] == tile && !taken[cell];
            if !is(cell, &taken) {
                continue;
            }
            let (left, top) = self.coordinates(cell);
            let right =
                (left..self.width).find(|&x| !is(self.cell(x, top), &taken)).unwrap_or(self.width);
            let same = |y: usize| (left..right).all(|x| is(self.cell(x, y), &taken));
            let bottom = (top..self.height()).find(|&y| !same(y)).unwrap_or(self.height());
            for y in top..bottom {
                taken[self.cell(left, y)..self.cell(left, y) + right - left].fill(true);
            }
            found.push([left, top, right, bottom]);
        }
        found
    }

    /// Number of columns.
    pub fn width(&self) -> usize {
        self.width
    }

    /// Number of rows.
    pub fn height(&self) -> usize {
        self.tiles.len() / self.width
    }

    /// Number of cells, walls and lava included.
    pub fn cells(&self) -> usize {
        self.tiles.len()
    }

    /// The cell in which an episode starts.
    pub fn start(&self) -> usize {
        self.start
    }

    /// The cell in column x and row y.
    ///
    /// # Panics
    /// If the map has no such cell.
    pub fn cell(&self, x: usize, y: usize) -> usize {
        assert!(x < self.width && y < self.height(), "cell ({x}, {y}) lies outside the map");
        y * self.width + x
    }

    /// Column x and row y of a cell.
    pub fn coordinates(&self, cell: usize) -> (usize, usize) {
        (cell % self.width, cell / self.width)
    }

    /// What a cell is.
    pub fn tile(&self, cell: usize) -> Tile {
        self.tiles[cell]
    }
}

impl std::fmt::Display for Map {
    /// The picture from which [`Map::parse`] reads the same map.
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        for (cell, tile) in self.tiles.iter().enumerate() {
            let character = match tile {
                Tile::Free if cell == self.start => 'S',
                Tile::Free => '.',
                Tile::Lava => 'L',
                Tile::Goal => 'G',
                Tile::LesserGoal => 'g',
                Tile::Wall => '#',
            };
            write!(formatter, "{character}")?;
            if (cell + 1) % self.width == 0 {
                writeln!(formatter)?;
            }
        }
        Ok(())
    }
}
