# Only for type checkers: makes them look here before they look into the installed wheel.
