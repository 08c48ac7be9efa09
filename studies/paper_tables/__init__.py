"""The tables of Chi 2017, Li 2018 and Sui 2017, made again by recipes."""
