"""How long tests wait for what has to come: a guard against hanging, and no verdict on speed."""

PATIENCE = 900.0  # s, for a machine that has much else to do
