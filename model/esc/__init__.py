"""The EtherCAT SubDevice controller and the virtual SubDevice around it."""
