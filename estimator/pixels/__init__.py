"""The pixel model of maximum likelihood: LED shapes rasterised, blurred and compared with the measured pixels."""
