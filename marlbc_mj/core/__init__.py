"""The laws of the mission (behaviors, composition, orders, disturbances) and how a law is compiled."""
