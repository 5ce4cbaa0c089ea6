"""What every command needs: arguments, console, outputs, policy files, how it ends."""
