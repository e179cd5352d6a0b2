"""What every folder uses: configs, ranges, the registry, compilation, versions of other packages, files of others."""
