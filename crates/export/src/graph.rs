//! Expressions as a graph in which equal parts are one node.

use std::collections::HashMap;

use greybox_model::Expr;
use greybox_model::expr::{BinOp, Func};

use crate::function::Function;

/// Largest integer exponent that is written as a product.
const LONGEST_PRODUCT: u32 = 16;

/// A node; operands are indices of earlier nodes.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub(crate) enum Node {
    /// A number, by its bits.
    Number(u64),
    /// A symbol.
    Symbol(String, u8),
    Negative(usize),
    Binary(Operator, usize, usize),
    Call(Func, Vec<usize>),
}

/// What is left of the operators: integer powers are products.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(crate) enum Operator {
    Add,
    Subtract,
    Multiply,
    Divide,
    Power,
}

/// All outputs of a function.
#[derive(Debug, Default)]
pub(crate) struct Graph {
    pub(crate) nodes: Vec<Node>,
    /// How often each node is an operand or an output.
    pub(crate) uses: Vec<usize>,
    pub(crate) outputs: Vec<usize>,
    index: HashMap<Node, usize>,
}

impl Graph {
    pub(crate) fn of(function: &Function) -> Graph {
        let mut graph = Graph::default();
        for (_, expression) in &function.outputs {
            let node = graph.add(expression);
            graph.uses[node] += 1;
            graph.outputs.push(node);
        }
        graph
    }

    fn add(&mut self, e: &Expr) -> usize {
        let node = match e {
            Expr::Num(v) => Node::Number(v.to_bits()),
            Expr::Var { name, primes } => Node::Symbol(name.to_string(), *primes),
            Expr::Neg(a) => Node::Negative(self.add(a)),
            Expr::Bin(BinOp::Pow, a, b) => return self.power(a, b),
            Expr::Bin(op, a, b) => {
                let (a, b) = (self.add(a), self.add(b));
                let op = match op {
                    BinOp::Add => Operator::Add,
                    BinOp::Sub => Operator::Subtract,
                    BinOp::Mul => Operator::Multiply,
                    BinOp::Div => Operator::Divide,
                    BinOp::Pow => Operator::Power,
                };
                Node::Binary(op, a, b)
            }
            Expr::Call(f, args) => Node::Call(*f, args.iter().map(|a| self.add(a)).collect()),
        };
        self.insert(node)
    }

    /// An integer power by repeated squaring, any other by the library's function.
    fn power(&mut self, a: &Expr, b: &Expr) -> usize {
        let base = self.add(a);
        let exponent = b.constant().filter(|v| v.fract() == 0.0 && v.abs() <= f64::from(LONGEST_PRODUCT));
        let Some(exponent) = exponent else {
            let b = self.add(b);
            return self.insert(Node::Binary(Operator::Power, base, b));
        };
        let one = Node::Number(1f64.to_bits());
        let mut left = exponent.abs() as u32;
        let (mut square, mut product) = (base, None);
        while left > 0 {
            if left % 2 == 1 {
                product = Some(match product {
                    None => square,
                    Some(p) => self.insert(Node::Binary(Operator::Multiply, p, square)),
                });
            }
            left /= 2;
            if left > 0 {
                square = self.insert(Node::Binary(Operator::Multiply, square, square));
            }
        }
        match product {
            None => self.insert(one),
            Some(p) if exponent > 0.0 => p,
            Some(p) => {
                let one = self.insert(one);
                self.insert(Node::Binary(Operator::Divide, one, p))
            }
        }
    }

    fn insert(&mut self, node: Node) -> usize {
        if let Some(&known) = self.index.get(&node) {
            return known;
        }
        match &node {
            Node::Number(_) | Node::Symbol(..) => {}
            Node::Negative(a) => self.uses[*a] += 1,
            Node::Binary(_, a, b) => {
                self.uses[*a] += 1;
                self.uses[*b] += 1;
            }
            Node::Call(_, args) => args.iter().for_each(|a| self.uses[*a] += 1),
        }
        self.nodes.push(node.clone());
        self.uses.push(0);
        self.index.insert(node, self.nodes.len() - 1);
        self.nodes.len() - 1
    }

    /// Whether a function of the language occurs.
    pub(crate) fn calls(&self, f: Func) -> bool {
        self.nodes.iter().any(|n| matches!(n, Node::Call(g, _) if *g == f))
    }
}
